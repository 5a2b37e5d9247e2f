"""Trajectories as SLAM tools and evo read them: TUM and KITTI. Camera to world, OpenCV axes."""

from __future__ import annotations

from pathlib import Path

from biresnerf.data.formats.tables.write_llff import rows_by_name
from biresnerf.data.model.atomic_file import whole_file
from biresnerf.data.model.conventions import quat_wxyz_from_rotation
from biresnerf.data.model.refined_set import RefinedSet

_TUM_HEAD = (
    "# timestamp tx ty tz qx qy qz qw: camera to world, OpenCV axes (x right, y down, z forward), the input's frame",
)


def write_tum(refined: RefinedSet, path: Path) -> None:
    """One line an image: time (s), centre, quaternion with the scalar last.

    Times are the input's; where it had none, the images' numbers, counted from 0 in the input's order. Comments
    at the top say which image each is.
    """
    times = refined.timestamps_s or tuple(float(i) for i in range(len(refined)))
    lines = [*_TUM_HEAD]
    lines += [f"# {time!r} {image.name}" for time, image in zip(times, refined.images, strict=True)]
    for time, pose in zip(times, refined.world_from_cam, strict=True):
        w, x, y, z = quat_wxyz_from_rotation(pose[:3, :3]).tolist()
        lines.append(" ".join(repr(value) for value in (time, *pose[:3, 3].tolist(), x, y, z, w)))
    _write_lines(path, lines)


def write_kitti(refined: RefinedSet, path: Path) -> None:
    """One line an image: the 12 numbers of [R | t], row by row.

    The form knows neither names nor comments, so lines are in the order of the files' names, as readers take them.
    """
    poses = refined.world_from_cam[rows_by_name(refined)]
    _write_lines(path, [" ".join(repr(value) for value in pose[:3].ravel().tolist()) for pose in poses])


def _write_lines(path: Path, lines: list[str]) -> None:
    # A name may hold anything but what ends a line.
    plain = [" ".join(line.splitlines()) for line in lines]
    with whole_file(path) as temporary:
        temporary.write_text("\n".join(plain) + "\n", "utf-8")
