"""The one place that knows how files write poses: OpenGL axes, applied transforms, quaternions.

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


def quat_wxyz_from_rotation(rotation: NDArray[np.float64]) -> NDArray[np.float64]:
    """Unit quaternion (w, x, y, z), w >= 0, of a rotation matrix [3, 3].

    It is the largest eigenvector of a symmetric 4 x 4 matrix (Bar-Itzhack 2000), so no branch loses digits
    near half turns.
    """
    (a, b, c), (d, e, f), (g, h, i) = np.asarray(rotation, dtype=np.float64)
    k = np.array(
        [
            [a + e + i, h - f, c - g, d - b],
            [h - f, a - e - i, b + d, c + g],
            [c - g, b + d, e - a - i, f + h],
            [d - b, c + g, f + h, i - a - e],
        ]
    )
    quat_wxyz = np.linalg.eigh(k)[1][:, -1]
    return -quat_wxyz if quat_wxyz[0] < 0 else quat_wxyz


def rotation_from_quat_wxyz(quat_wxyz: NDArray[np.float64]) -> NDArray[np.float64]:
    """Rotation matrix [3, 3] of a quaternion (w, x, y, z); its length does not matter."""
    w, x, y, z = np.asarray(quat_wxyz, dtype=np.float64) / np.linalg.norm(quat_wxyz)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
