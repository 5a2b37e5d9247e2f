"""The one place that knows how files write poses: OpenGL axes, applied transforms.

Inside, poses are ``world_from_cam`` with OpenCV axes (x right, y down, z forward). transforms.json holds
camera-to-world matrices with OpenGL axes (x right, y up, camera looks along -z), in a world that nerfstudio's
``applied_transform`` and ``applied_scale`` may have moved.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

OPENCV_FROM_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])


def world_from_cam_of_file(
    matrix: NDArray[np.float64], applied_transform: NDArray[np.float64], applied_scale: float
) -> NDArray[np.float64]:
    """Poses [..., 4, 4] in our convention from a file's ``transform_matrix`` values [..., 4, 4]."""
    moved = np.array(matrix, dtype=np.float64)
    moved[..., :3, 3] /= applied_scale
    return np.linalg.inv(applied_transform) @ moved @ OPENCV_FROM_OPENGL


def file_from_world_from_cam(
    world_from_cam: NDArray[np.float64], applied_transform: NDArray[np.float64], applied_scale: float
) -> NDArray[np.float64]:
    """A file's ``transform_matrix`` values [..., 4, 4] from poses [..., 4, 4]: the inverse of the reading."""
    moved = applied_transform @ np.asarray(world_from_cam, dtype=np.float64) @ OPENCV_FROM_OPENGL
    moved[..., :3, 3] *= applied_scale
    return moved
