"""The product's inputs from a set: photos alone, or with noisy poses; and the photos' GPS positions."""

from __future__ import annotations

import json
import os
import shutil
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from biresnerf.data.photos.geotags import read_geotag
from biresnerf.geometry.camera.camera_models import Camera
from biresnerf.geometry.camera.lens import lens_problem
from biresnerf.geometry.perturb import perturb_poses
from biresnerf.geometry.similarity import align_robust

Array = NDArray[np.float64]
NOISE, SEED = 0.15, 1  # turns cameras about the scene by 14 degrees on average
FLIP = np.diag([1.0, -1.0, -1.0, 1.0])  # between OpenCV's axes of the camera and OpenGL's
EARTH_M = 6_371_000.0


def photos_alone(source: Path, names: tuple[str, ...], folder: Path) -> Path:
    """A folder with links to the photos, byte for byte as published."""
    photos = folder / "images"
    shutil.rmtree(photos, ignore_errors=True)  # of an earlier run with more of them
    photos.mkdir(parents=True)
    for name in names:
        os.link(source / name, photos / Path(name).name)
    return folder


def with_poses(folder: Path, frames: list[dict[str, Any]], *, noise: float) -> Path:
    """Writes a transforms.json beside the photos: `frames` as `colmap_child.place` gives them, lenses included."""
    poses = np.array([frame["world_from_cam"] for frame in frames])
    if noise:
        poses = perturb_poses(poses, noise, SEED)
    rows = [
        {"file_path": f"images/{Path(frame['name']).name}", "transform_matrix": (pose @ FLIP).tolist(), **lens(frame)}
        for frame, pose in zip(frames, poses, strict=True)
    ]  # fmt: skip
    (folder / "transforms.json").write_text(json.dumps({"camera_model": "OPENCV", "frames": rows}), "utf-8")
    return folder


def lens(frame: dict[str, Any]) -> dict[str, Any]:
    """An OPENCV lens as keys of transforms.json."""
    keys = ("fl_x", "fl_y", "cx", "cy", "k1", "k2", "p1", "p2")
    full = _camera(frame).full()
    params = (full.fx, full.fy, full.cx, full.cy, full.k1, full.k2, full.p1, full.p2)
    return {"w": frame["lens"]["width"], "h": frame["lens"]["height"], **dict(zip(keys, params, strict=True))}


def lenses_are_real(frames: list[dict[str, Any]]) -> bool:
    """Whether every pixel has a viewing ray: from few photos, COLMAP may find lenses that fold."""
    cameras = (_camera(frame) for frame in frames)
    return all(lens_problem(c.full(), c.width, c.height) is None for c in cameras)


def _camera(frame: dict[str, Any]) -> Camera:
    """The camera of COLMAP's SIMPLE_RADIAL or OPENCV lens."""
    found = frame["lens"]
    return Camera(found["model"], found["width"], found["height"], tuple(found["params"]))


def gps_places(source: Path, names: tuple[str, ...]) -> dict[str, Array]:
    """GPS positions in metres east, north and up from the first, by file name; only of photos that have one."""
    tags = {Path(name).name: read_geotag(source / name, name) for name in names}
    known = {name: tag.place for name, tag in tags.items() if tag is not None}
    return {name: metres_from(next(iter(known.values())), place) for name, place in known.items()}


def metres_from(origin: tuple[float, float, float], place: tuple[float, float, float]) -> Array:
    """East, north and up (m) from latitude, longitude (degrees) and height (m); flat earth, a few hundred metres."""
    north, east = np.radians(place[0] - origin[0]), np.radians(place[1] - origin[1])
    return np.array(
        [east * np.cos(np.radians(origin[0])) * EARTH_M, north * EARTH_M, place[2] - origin[2]], dtype=np.float64
    )  # fmt: skip


def gps_residual(poses: dict[str, Array], places: dict[str, Array]) -> float | None:
    """Median distance (m) of cameras from their GPS positions after similarity alignment; None for under six."""
    shared = sorted(poses.keys() & places.keys())
    if len(shared) < 6:
        return None
    rig = np.stack([poses[name] for name in shared])
    there = np.tile(np.eye(4), (len(shared), 1, 1))
    there[:, :3, 3] = [places[name] for name in shared]
    moved = align_robust(rig, there).apply_to_poses(rig)
    return float(np.median(np.linalg.norm(moved[:, :3, 3] - there[:, :3, 3], axis=1)))
