"""Given poses read in another way than their format says: inverted, with other axes, transposed, and so on."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from biresnerf.data.model.conventions import (
    OPENCV_FROM_OPENGL,
    file_from_world_from_cam,
    world_from_cam_of_file,
)
from biresnerf.data.model.dataset import Dataset, SourceFormat
from biresnerf.geometry.rigid import quat_wxyz_from_rotation, rotation_from_quat_wxyz
from biresnerf.options.formats import Format, formats
from biresnerf.options.given_poses import PoseReading

_AXES = {"opencv": np.eye(4), "opengl": OPENCV_FROM_OPENGL}
# Left-handed, x right, y up, z forward: the world's z is turned round, as exporters to glTF do, and the camera's y.
_MIRROR, _Y_DOWN = np.diag([1.0, 1.0, -1.0, 1.0]), np.diag([1.0, -1.0, 1.0, 1.0])
_QUARTER = np.array([[0.0, 1, 0, 0], [-1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
_ROLLS: tuple[PoseReading, ...] = ("rolled_90", "rolled_180", "rolled_270")


def format_of(source: SourceFormat) -> Format:
    """How the input's format writes poses. Blender's dialect is no format of its own."""
    return formats().get(source.dialect, formats()["transforms"])


def poses_read_as(
    world_from_cam: NDArray[np.float64], source: SourceFormat, reading: Sequence[PoseReading]
) -> NDArray[np.float64]:
    """Poses [n, 4, 4], read from ``source`` as its format says, converted to ``reading``.

    The file's own matrices are restored and read again; what ``reading`` does not name stays.
    """
    form = format_of(source)
    # Of a file with ``applied_transform`` the matrices lie in the world that this leads to.
    matrix = file_from_world_from_cam(world_from_cam, source.applied_transform, source.applied_scale)
    matrix = matrix @ OPENCV_FROM_OPENGL @ _AXES[form.axes]
    matrix = np.linalg.inv(matrix) if form.cam_from_world else matrix
    order = next((one for one in reading if one in ("wxyz", "xyzw")), form.quaternion)
    if order != form.quaternion:
        matrix[:, :3, :3] = [_reordered(rotation, order) for rotation in matrix[:, :3, :3]]
    if "transposed" in reading:
        matrix[:, :3, :3] = matrix[:, :3, :3].swapaxes(1, 2).copy()
    if form.cam_from_world != ("inverted" in reading):
        matrix = np.linalg.inv(matrix)
    if "left_handed" in reading:
        matrix = _MIRROR @ matrix @ _Y_DOWN
    else:
        axes = next((name for name in _AXES if f"{name}_axes" in reading), form.axes)
        matrix = matrix @ _AXES[axes]
    for turns, roll in enumerate(_ROLLS, 1):
        if roll in reading:
            matrix = matrix @ np.linalg.matrix_power(_QUARTER, turns)
    read: NDArray[np.float64] = world_from_cam_of_file(
        matrix @ OPENCV_FROM_OPENGL, source.applied_transform, source.applied_scale
    )
    return read


def _reordered(rotation: NDArray[np.float64], order: str) -> NDArray[np.float64]:
    """The rotation whose quaternion has the same four numbers, in the other order."""
    w, x, y, z = quat_wxyz_from_rotation(rotation)
    # Its numbers were (x, y, z, w), and the first of them is the scalar; or (w, x, y, z), and the last of them is.
    return rotation_from_quat_wxyz(np.array([x, y, z, w] if order == "wxyz" else [z, w, x, y]))


def read_as(dataset: Dataset, reading: Sequence[PoseReading]) -> Dataset:
    """The set with its given poses read so; points, rigs and ids of a COLMAP model, which fit the old ones, go."""
    rows = np.flatnonzero(dataset.posed)
    if not reading or not len(rows):
        return dataset
    frames = list(dataset.frames)
    given = np.stack([pose for frame in frames if (pose := frame.world_from_cam) is not None])
    for row, pose in zip(rows, poses_read_as(given, dataset.source, reading), strict=True):
        frames[row] = replace(frames[row], world_from_cam=pose)
    return replace(dataset, frames=tuple(frames), source=replace(dataset.source, colmap=None))
