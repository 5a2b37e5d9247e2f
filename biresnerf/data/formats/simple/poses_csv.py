"""``poses.csv``: one row an image, for spreadsheets and scripts: where it was taken, and how exactly that is known.

Other tables are read, too, if their header names an image, a position and a quaternion: camera to world, OpenCV axes.
"""

from __future__ import annotations

import csv
import io
from pathlib import Path

from biresnerf.data.formats.codec import Codec, head_of
from biresnerf.data.formats.colmap.model_checks import image_name
from biresnerf.data.formats.parsed_poses import ParsedPoses
from biresnerf.data.formats.pose_rows import Placed, parsed_rows, pose_of_numbers
from biresnerf.data.formats.simple.camera_file import read_camera_file
from biresnerf.data.model.atomic_file import write_text
from biresnerf.data.model.refined_set import RefinedSet
from biresnerf.data.model.untrusted_file import Table, invalid_file, read_table, read_text
from biresnerf.geometry.rigid import quat_wxyz_from_rotation
from biresnerf.options.formats import Format

POSES_CSV = Format(
    name="csv",
    title="poses.csv",
    rank=91,
    found_as=("poses.csv", "*.csv"),
    suffixes=(".csv",),
    gives="any table with image, position and quaternion; a lens in camera.json",
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

_VALUES = ("x", "y", "z", "w", "i", "j", "k")
_TITLES = {
    "name": ("(image|img|photo|file|frame)?(name|path|file)|image|img|photo",),
    **{axis: (f"(t|p|c|pos|position|translation|cent(er|re)|camera)?{axis}",) for axis in "xyz"},
    **{
        part: (f"(q|quat|quaternion|rot|rotation|orientation){axis}",)
        for part, axis in zip("wijk", "wxyz", strict=True)
    },
}
_HINT = "Give columns image, x, y, z, qw, qx, qy, qz: camera to world, OpenCV axes."


def parse_poses_csv(root: Path, file: Path) -> ParsedPoses:
    """The poses of the table ``file``, each for the image of its name."""
    table = _table(file, read_text(file))
    if table is None:
        raise invalid_file(file.name, "has no head that names an image, a position and a quaternion.", _HINT)
    lens, _, camera_files = read_camera_file(root)

    def read(row: list[str], where: str) -> Placed:
        numbers = table.numbers(row, _VALUES, where, _HINT)
        return pose_of_numbers(POSES_CSV, numbers[3:], numbers[:3], where, _HINT), lens

    rows = [(image_name(table.cell(row, "name"), where), where, row) for where, row in table.rows if any(row)]
    note = f"{file.name} was read as camera to world with OpenCV axes"
    return parsed_rows(POSES_CSV, [file, *camera_files], rows, read, notes=(note,))


def _table(file: Path, text: str) -> Table | None:
    return read_table(file.name, text.splitlines(), _TITLES, lambda found: len(found) == len(_TITLES))


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
        recognises=lambda file: _table(file, head_of(file).decode("utf-8-sig", "replace")) is not None,
        write=lambda refined, path, _: write_poses_csv(refined, path),
    ),
)
