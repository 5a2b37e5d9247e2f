"""COLMAP's binary model (cameras.bin, images.bin, points3D.bin), written without COLMAP.

Layout: src/colmap/scene/reconstruction_io_binary.cc; little-endian throughout. The text form is not written:
every reader of it cuts image names at the first space.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from biresnerf.data.atomic_file import whole_file
from biresnerf.data.conventions import quat_wxyz_from_rotation
from biresnerf.data.dataset import Camera
from biresnerf.geometry.camera_models import MODEL_IDS

# A file of no points must be there: readers fail without it.
_NO_POINTS = struct.pack("<Q", 0)


def write_colmap_model(
    folder: Path,
    cameras: Sequence[Camera],
    names: Sequence[str],
    camera_indices: Sequence[int],
    world_from_cam: NDArray[np.float64],
) -> None:
    """Writes the three files into ``folder``, each whole or not at all.

    Args:
        folder: made where it is missing (COLMAP wants ``sparse/0``).
        cameras: at full size; ids are their positions counted from 1.
        names: of the images, relative to the image folder, unique, without NUL.
        camera_indices: of each image.
        world_from_cam: float64 [n, 4, 4], OpenCV axes.
    """
    if len(set(names)) != len(names) or any("\0" in name or not name for name in names):
        raise ValueError("image names must be unique, not empty, and without NUL")
    if world_from_cam.shape != (len(names), 4, 4) or not np.isfinite(world_from_cam).all():
        raise ValueError(
            f"poses must be finite and of shape ({len(names)}, 4, 4), not {world_from_cam.shape}"
        )
    _write(folder / "points3D.bin", _NO_POINTS)
    _write(folder / "cameras.bin", _cameras(cameras))
    _write(folder / "images.bin", _images(names, camera_indices, world_from_cam))


def _cameras(cameras: Sequence[Camera]) -> bytes:
    parts = [struct.pack("<Q", len(cameras))]
    for number, camera in enumerate(cameras, start=1):
        parts.append(struct.pack("<IiQQ", number, MODEL_IDS[camera.model], camera.width, camera.height))
        parts.append(struct.pack(f"<{len(camera.params)}d", *camera.params))
    return b"".join(parts)


def _images(
    names: Sequence[str], camera_indices: Sequence[int], world_from_cam: NDArray[np.float64]
) -> bytes:
    parts = [struct.pack("<Q", len(names))]
    for number, (name, camera, pose) in enumerate(
        zip(names, camera_indices, world_from_cam, strict=True), start=1
    ):
        cam_from_world_rotation = pose[:3, :3].T
        translation = -cam_from_world_rotation @ pose[:3, 3]
        quat_wxyz = quat_wxyz_from_rotation(cam_from_world_rotation)
        parts.append(struct.pack("<I7dI", number, *quat_wxyz, *translation, camera + 1))
        parts.append(name.encode() + b"\0" + struct.pack("<Q", 0))
    return b"".join(parts)


def _write(path: Path, content: bytes) -> None:
    with whole_file(path) as temporary:
        temporary.write_bytes(content)
