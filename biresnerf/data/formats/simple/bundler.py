"""Bundler's ``bundle.out`` (v0.3) and its list of images: cameras only, the points are not kept.

Cameras look along -z with y up, have one focal length, two radial coefficients and their principal point in the
image's centre. Format: Bundler v0.4 user's manual, section 6.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from biresnerf.data.formats.codec import Codec, LensLimits
from biresnerf.data.formats.colmap.model_checks import camera_of_numbers, listed_name
from biresnerf.data.formats.parsed_poses import ParsedPoses
from biresnerf.data.formats.pose_rows import Placed, at_size_of, parsed_rows, pose_by
from biresnerf.data.model.atomic_file import write_text
from biresnerf.data.model.refined_set import RefinedSet
from biresnerf.data.model.untrusted_file import finite_numbers, invalid_file, read_text, read_words
from biresnerf.errors import InputError
from biresnerf.geometry.camera.camera_models import Camera
from biresnerf.options.formats import Format

BUNDLER = Format(
    name="bundler",
    title="Bundler",
    rank=60,
    found_as=("bundle.out", "bundle/bundle.out", "bundle.rd.out"),
    suffixes=(".out",),
    gives="poses, focal length, two radial coefficients; v0.3",
    checked_against="its manual",
    axes="opengl",
    cam_from_world=True,
    in_set="bundle.out",
    in_result="bundler/bundle.out",
    loses=("some lenses", "rigs", "mask paths"),
    instead="pinhole",
    heading="For Metashape",
    hint="Bundler format: File › Import › Import Cameras",
    downloads="bundler/",
)

LIST_NAMES = ("list.txt", "bundle/list.txt", "list.rd.txt", "bundle/list.rd.txt")
_HINT = "Export the bundle file (v0.3) again."
_LIST_HINT = "Give list.txt as it was written with the bundle file: one image a line, in its order."
_LINES_PER_CAMERA, _LINES_PER_POINT = 5, 3
_OPENCV_FROM_OPENGL = np.diag([1.0, -1.0, -1.0])
LENSES = LensLimits("Bundler", ("k1", "k2"), fisheye=None, two_focal_lengths=False, off_centre=False)


def parse_bundler(root: Path, file: Path) -> ParsedPoses:
    """The cameras of a bundle file; those with a focal length of 0 have no pose.

    list.txt, beside the images or the file, says which image each camera is (bundle.rd.out goes with list.rd.txt, both
    of undistorted images); without it their order by name does.
    """
    blocks = _blocks(file)
    list_file, listed = _listed_names(root, file, len(blocks))
    files = [file] if list_file is None else [file, list_file]
    rows = [
        (name, f"{file.name} camera {at}", block)
        for at, (name, block) in enumerate(zip(listed, blocks, strict=True))
    ]
    if list_file is not None:
        return parsed_rows(BUNDLER, files, rows, _read)
    return parsed_rows(BUNDLER, files, rows, _read, in_order_of_names="natural", order_hint=_LIST_HINT)


def _blocks(file: Path) -> list[list[list[str]]]:
    """The words of the lines of each camera. Raises InputError ``pose_file_invalid``."""
    lines = [words for _, words in read_words(file)]
    counts = _numbers(lines[:1], 1, 2, f"{file.name} first line")[0]
    if not all(count == round(count) and count >= 0 for count in counts):
        raise invalid_file(
            f"{file.name} first line", "does not give the numbers of cameras and points.", _HINT
        )
    cameras, points = int(counts[0]), int(counts[1])
    if len(lines) != 1 + _LINES_PER_CAMERA * cameras + _LINES_PER_POINT * points:
        raise invalid_file(
            file.name,
            f"has {len(lines)} lines, which is not what {cameras} cameras and {points} points take.",
            _HINT,
        )
    starts = [1 + _LINES_PER_CAMERA * index for index in range(cameras)]
    return [lines[at : at + _LINES_PER_CAMERA] for at in starts]


def _read(lines: list[list[str]], where: str) -> Placed:
    block = _numbers(lines, _LINES_PER_CAMERA, 3, where)
    focal, k1, k2 = block[0].tolist()
    if focal == 0.0:
        return None, None

    def lens(width: int, height: int) -> Camera:
        full = (focal, width / 2, height / 2)
        model, params = ("RADIAL", (*full, k1, k2)) if k1 or k2 else ("SIMPLE_PINHOLE", full)
        return camera_of_numbers(model, width, height, params, where)

    return pose_by(BUNDLER, np.column_stack([block[1:4], block[4]]), where), at_size_of(lens)


def _numbers(lines: Sequence[Sequence[str]], rows: int, columns: int, where: str) -> NDArray[np.float64]:
    if len(lines) != rows or any(len(line) != columns for line in lines):
        raise invalid_file(where, f"is not {rows} lines of {columns} numbers.", _HINT)
    return finite_numbers([word for line in lines for word in line], where, _HINT).reshape(rows, columns)


def _listed_names(root: Path, file: Path, count: int) -> tuple[Path | None, list[str]]:
    """The file that lists the images, if there is one, and their names (else numbers) in the order of the cameras.

    Raises:
        InputError: ``pose_count_mismatch``, or a code of `listed_name`.
    """
    undistorted = ".rd." in file.name
    names = sorted(LIST_NAMES, key=lambda name: (".rd." in name) != undistorted)
    places = [folder / name for name in names for folder in (file.parent, root)]
    table = next((path for path in places if path.is_file()), None)
    if table is None:
        return None, [str(index) for index in range(count)]
    # `name`, or `name 0 focal_length` as Bundler's own tools write it.
    lines = [_without_focal(line.strip()) for line in read_text(table).splitlines() if line.strip()]
    listed = [listed_name(line, f"{table.name} line {number}") for number, line in enumerate(lines, start=1)]
    if len(listed) != count:
        what = f"{len(listed)} images for the {count} cameras of {file.name}."
        raise InputError("pose_count_mismatch", what, where=table.name, hint=_LIST_HINT)
    return table, listed


def _without_focal(line: str) -> str:
    words = line.rsplit(maxsplit=2)
    return (
        words[0] if len(words) == 3 and words[1] == "0" and words[2].replace(".", "", 1).isdigit() else line
    )


def write_bundler(refined: RefinedSet, folder: Path) -> None:
    """Writes ``bundle.out`` and ``list.txt`` (image names in the cameras' order) into ``folder``.

    Raises:
        InputError: ``export_not_possible``: a lens that the format cannot hold.
    """
    LENSES.refuse(refined.cameras, "bundler")
    lines = ["# Bundle file v0.3", f"{len(refined)} {len(refined.model.points)}"]
    for index, cam_from_world in enumerate(refined.cam_from_world):
        full = refined.camera_of(index).full()
        lines.append(f"{full.fx!r} {full.k1!r} {full.k2!r}")
        rows = _OPENCV_FROM_OPENGL @ cam_from_world[:3]
        lines += [" ".join(map(repr, row)) for row in [*rows[:, :3].tolist(), rows[:, 3].tolist()]]
    lines += _point_lines(refined)
    names = [" ".join(image.file_name.splitlines()) for image in refined.images]
    write_text(folder / "list.txt", "\n".join(names))
    write_text(folder / "bundle.out", "\n".join(lines))


def _point_lines(refined: RefinedSet) -> list[str]:
    lines = []
    for one in refined.landmarks():
        views = []
        for row, feature, (x, y) in one.features:
            camera = refined.camera_of(row)
            views.append(f"{row} {feature} {x - camera.width / 2!r} {camera.height / 2 - y!r}")
        lines += [" ".join(map(repr, values)) for values in (one.xyz, one.rgb)]
        lines.append(" ".join([str(len(views)), *views]))
    return lines


CODECS = (
    Codec(
        BUNDLER,
        parse=parse_bundler,
        image_root=lambda file: file.parent.parent if file.parent.name == "bundle" else file.parent,
        write=lambda refined, path, _: write_bundler(refined, path.parent),
        given_back=lambda dataset: dataset.source.dialect == "bundler",
    ),
)
