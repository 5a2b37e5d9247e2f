"""``poses.csv``: one row an image, for spreadsheets and scripts: where it was taken, and how exactly that is known.

Tables of others are read, too, if their head names an image, a position and a quaternion: camera to world, OpenCV axes.
"""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Sequence
from functools import partial
from pathlib import Path

from biresnerf.data.formats.codec import Codec
from biresnerf.data.formats.colmap.model_checks import image_name, rigid_pose
from biresnerf.data.formats.parsed_poses import ParsedPoses
from biresnerf.data.formats.pose_rows import Placed, Row, parsed_rows
from biresnerf.data.formats.simple.camera_file import read_camera_file
from biresnerf.data.model.atomic_file import write_text
from biresnerf.data.model.colmap_scene import matrix_of_pose
from biresnerf.data.model.conventions import quat_wxyz_from_rotation
from biresnerf.data.model.refined_set import RefinedSet
from biresnerf.data.model.untrusted_file import finite_numbers, invalid_file, read_text
from biresnerf.options.formats import Format

POSES_CSV = Format(
    name="csv",
    title="poses.csv",
    rank=91,
    found_as=("poses.csv", "*.csv"),
    suffixes=(".csv",),
    gives="poses, of any table with columns for image, position and quaternion; a camera from camera.json beside it",
    checked_against="SciPy's quaternions",
    in_set="poses.csv",
    always=True,
    loses=("lenses", "rigs", "points", "mask paths"),
    heading="For spreadsheets",
    hint="Each pose, and how exactly it is known",
)

# Centre and quaternion of world_from_cam, OpenCV axes, in the input's world; 90 % bounds of their errors, empty where
# not known.
COLUMNS = (
    "image", "x", "y", "z", "qw", "qx", "qy", "qz", "rotation_deg_90", "position_90", "known_from", "why_unknown",
    "pose_source", "flags",
)  # fmt: skip

_NAMES = "(image|img|photo|file|frame)?(name|path|file)|image|img|photo"
_AXES = "(t|p|c|pos|position|translation|cent(er|re)|camera)?{}"
_PARTS = "(q|quat|quaternion|rot|rotation|orientation){}"
_VALUES = tuple(_AXES.format(axis) for axis in "xyz") + tuple(_PARTS.format(part) for part in "wxyz")
_HINT = "Give columns image, x, y, z, qw, qx, qy, qz: camera to world, OpenCV axes."
_HEAD_BYTES = 4096


def parse_poses_csv(root: Path, file: Path) -> ParsedPoses:
    """The poses of the table ``file``, each for the image of its name.

    Raises:
        InputError: codes as in docs/input.md.
    """
    lines = read_text(file).splitlines()
    columns = _columns(lines[0] if lines else "")
    if columns is None:
        raise invalid_file(file.name, "has no head that names an image, a position and a quaternion.", _HINT)
    lens, _, camera_files = read_camera_file(root)

    def read(words: Sequence[str], where: str) -> Placed:
        if len(words) <= max(columns):
            raise invalid_file(where, f"has {len(words)} values, fewer than columns.", _HINT)
        x, y, z, *quat = finite_numbers([words[at] for at in columns[1:]], where, _HINT).tolist()
        turned = rigid_pose([*quat, x, y, z], where, _HINT)
        return matrix_of_pose(turned), lens

    rows: list[Row] = []
    for number, words in enumerate(csv.reader(lines[1:], delimiter=_delimiter(lines[0])), start=2):
        if any(words):
            where = f"{file.name} line {number}"
            name = words[columns[0]].strip() if columns[0] < len(words) else ""
            rows.append((image_name(name, where), where, partial(read, words, where)))
    note = f"{file.name} was read as camera to world with OpenCV axes"
    return parsed_rows("csv", [file, *camera_files], rows, notes=(note,))


def _delimiter(head: str) -> str:
    return max(",;\t", key=head.count)


def _columns(head: str) -> list[int] | None:
    """Where the head has the image's name, x, y, z, and the quaternion from w on; None where it lacks one."""
    names = [re.sub(r"[^a-z]", "", name.lower()) for name in head.split(_delimiter(head))]
    found = [
        next((at for at, name in enumerate(names) if re.fullmatch(pattern, name)), None)
        for pattern in (_NAMES, *_VALUES)
    ]
    known = [at for at in found if at is not None]
    return known if len(known) == len(found) else None


def _recognises(file: Path) -> bool:
    if not file.is_file():
        return False
    with file.open("rb") as opened:
        return _columns(opened.readline(_HEAD_BYTES).decode("utf-8-sig", "replace")) is not None


def write_poses_csv(refined: RefinedSet, path: Path) -> None:
    """Writes the file, whole or not at all; numbers with all their digits."""
    file = io.StringIO()
    table = csv.writer(file, lineterminator="\n")
    table.writerow(COLUMNS)
    for image in refined.images:
        known = image.uncertainty
        said = (
            ("", "", "", "")
            if known is None
            else (known.rotation_deg, known.position, known.known_from, known.why_unknown)
        )
        centre = image.world_from_cam[:3, 3].tolist()
        rotation = quat_wxyz_from_rotation(image.world_from_cam[:3, :3]).tolist()
        table.writerow([image.name, *centre, *rotation, *said, image.pose_source, " ".join(image.flags)])
    write_text(path, file.getvalue())


CODECS = (
    Codec(
        POSES_CSV,
        parse=parse_poses_csv,
        recognises=_recognises,
        write=lambda refined, path, _: write_poses_csv(refined, path),
    ),
)
