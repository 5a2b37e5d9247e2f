"""Photos of a patterned ball, taken from around it or from inside, with known poses."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from biresnerf.data.formats.read_dataset import read_dataset
from biresnerf.data.model.dataset import Dataset
from tests.data.scenes import save

SIZE, FOCAL = 160, 170.0


def looking(centre: NDArray[np.float64], along: NDArray[np.float64], roll: float) -> NDArray[np.float64]:
    """``world_from_cam`` of a camera that looks along a direction, OpenCV axes, z of the world up."""
    z = along / np.linalg.norm(along)
    x = np.cross(z, [0.0, 0.0, 1.0])
    x /= np.linalg.norm(x)
    y = np.cross(z, x)
    c, s = np.cos(roll), np.sin(roll)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([c * x + s * y, c * y - s * x, z], axis=1)
    pose[:3, 3] = centre
    return pose


def around(count: int = 9) -> NDArray[np.float64]:
    """Poses [n, 4, 4] on a part of a dome around the ball, at different heights and distances."""
    random = np.random.default_rng(5)
    poses = []
    for k in range(count):
        centre = (3.2 + 0.5 * random.random()) * np.array(
            [np.cos(0.16 * k), np.sin(0.16 * k), 0.25 + 0.35 * random.random()]
        )
        poses.append(looking(centre, -centre + 0.2 * random.normal(size=3), 0.08 * random.normal()))
    return np.stack(poses)


def inside(count: int = 20) -> NDArray[np.float64]:
    """Poses [n, 4, 4] as of a phone at arm's length that looks outward: axes meet behind every camera."""
    random = np.random.default_rng(6)
    out = [np.array([np.cos(0.14 * k), np.sin(0.14 * k), 0.3 * random.normal() - 0.2]) for k in range(count)]
    return np.stack([looking(0.3 * one, one, 0.08 * random.normal()) for one in out])


def photo(pose: NDArray[np.float64]) -> NDArray[np.uint8]:
    """The ball of radius 1 from outside; from inside, the wall of a round room of radius 1."""
    grid = (np.arange(SIZE) + 0.5 - SIZE / 2) / FOCAL
    x, y = np.meshgrid(grid, grid)
    rays = np.stack([x, y, np.ones_like(x)], axis=-1) @ pose[:3, :3].T
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    centre = pose[:3, 3]
    half, rest = rays @ centre, centre @ centre - 1.0
    root = half**2 - rest
    near = np.where(rest > 0, -1.0, 1.0)
    at = centre + (near * np.sqrt(np.maximum(root, 0.0)) - half)[..., None] * rays
    random = np.random.default_rng(7)
    waves, phases = random.normal(size=(14, 3)) * 12.0, random.uniform(0, 2 * np.pi, 14)
    value = np.sin(at @ waves.T + phases).sum(axis=-1)
    return np.where(root > 0, 128 + 110 * np.tanh(value), 0).astype(np.uint8)


def written(
    folder: Path, poses: NDArray[np.float64], photos_of: NDArray[np.float64] | None = None
) -> Dataset:
    """The set of these poses in a transforms.json, read back; its photos are those of other poses where given."""
    (folder / "images").mkdir(parents=True)
    frames = []
    for k, pose in enumerate(poses):
        name = f"images/{k:02}.png"
        Image.fromarray(photo((poses if photos_of is None else photos_of)[k])).save(folder / name)
        frames.append({"file_path": name, "transform_matrix": (pose @ np.diag([1.0, -1, -1, 1])).tolist()})
    lens = {"w": SIZE, "h": SIZE, "fl_x": FOCAL, "cx": SIZE / 2, "cy": SIZE / 2}
    return read_dataset(save(folder, {**lens, "frames": frames}))
