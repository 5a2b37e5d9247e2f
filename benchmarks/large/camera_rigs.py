"""Cameras that see nearby surfaces, with their observations and the exact truth: for `many_cameras`."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from biresnerf.data.points.tracks import Tracks
from biresnerf.geometry.camera.camera import Intrinsics, project
from biresnerf.geometry.camera.camera_models import Camera
from biresnerf.geometry.lie import so3_exp
from biresnerf.refinement.adjustment.evidence import Evidence, PosePrior

Array = NDArray[np.float64]

SHAPES = ("ring", "corridor", "aerial")
SIZE, FOCAL = 400, 500.0
CAMERA = Camera("PINHOLE", SIZE, SIZE, (FOCAL, FOCAL, SIZE / 2, SIZE / 2))
AWAY = 4.0  # from the surface; a photo shows 3.2 of it
ALONG, ACROSS = (
    0.4,
    1.28,
)  # between cameras; across is between the lines of a flight, whose photos are twice as far apart
RELIEF = 0.8  # of the surface
SEEN = 100  # points in a photo
NOISE_PX, WRONG = 0.5, 0.02  # of observations, and the share that is anywhere
OFF_RAD, OFF = 0.005, 0.03  # of each given pose, each axis


@dataclass(frozen=True, eq=False)
class Rig:
    """Cameras with their true poses [n, 4, 4], their given poses, and their observations."""

    truth: Array
    given: Array
    evidence: Evidence

    @property
    def prior(self) -> PosePrior:
        return PosePrior.equal(self.given, OFF_RAD, OFF)


def rig(shape: str, count: int, seed: int = 0) -> Rig:
    """A rig of ``count`` cameras around a ring, along a corridor's wall, or in a flight's lines."""
    rng = np.random.default_rng(seed)
    truth, points, near = {"ring": _ring, "corridor": _corridor, "aerial": _aerial}[shape](count, rng)
    truth[:, :3, :3] = truth[:, :3, :3] @ _turns(rng, count, 0.05)
    truth[:, :3, 3] += rng.normal(0, 0.05, (count, 3))
    intrinsics = Intrinsics.from_cameras([CAMERA] * count)
    given = truth.copy()
    given[:, :3, :3] = _turns(rng, count, OFF_RAD) @ truth[:, :3, :3]
    given[:, :3, 3] += rng.normal(0, OFF, (count, 3))
    return Rig(truth, given, Evidence(intrinsics, _observed(truth, points, near, intrinsics, rng)))


def _ring(count: int, rng: np.random.Generator) -> tuple[Array, Array, Array]:
    """Cameras around a cylinder, looking at its axis."""
    radius = max(count * ALONG / (2 * np.pi), AWAY + 1)
    angle = 2 * np.pi * np.arange(count) / count
    out = np.stack([np.cos(angle), np.sin(angle), np.zeros(count)], 1)
    wall = radius - AWAY
    on = rng.uniform(0, 2 * np.pi, _points(count * ALONG * wall / radius))
    place = (wall - rng.uniform(0, RELIEF, len(on)))[:, None] * np.stack([np.cos(on), np.sin(on)], 1)
    points = np.concatenate([place, rng.uniform(-1.6, 1.6, (len(on), 1))], 1)
    return _looking(radius * out, -out), points, radius * np.stack([np.cos(on), np.sin(on), 0 * on], 1)


def _corridor(count: int, rng: np.random.Generator) -> tuple[Array, Array, Array]:
    """Cameras along a wall, looking at it."""
    length = count * ALONG
    along, none = np.arange(count) * ALONG, np.zeros(count)
    x = rng.uniform(-1, length + 1, _points(length))
    y, z = AWAY + rng.uniform(0, RELIEF, len(x)), rng.uniform(-1.6, 1.6, len(x))
    centres = np.stack([along, none, none], 1)
    return (
        _looking(centres, np.tile([0.0, 1.0, 0.0], (count, 1))),
        np.stack([x, y, z], 1),
        np.stack([x, 0 * x, 0 * x], 1),
    )


def _aerial(count: int, rng: np.random.Generator) -> tuple[Array, Array, Array]:
    """Cameras on a flight's lines over land, looking down."""
    lines = max(1, round((count * 2 * ALONG / ACROSS) ** 0.5))
    number = np.arange(count)
    line = number * lines // count
    first = np.searchsorted(line, np.arange(lines))
    place = np.stack([2 * ALONG * (number - first[line]), ACROSS * line], 1)
    centres = np.concatenate([place, np.full((count, 1), AWAY)], 1)
    extent = place.max(0) + 2
    total = round(extent[0] * extent[1] / 3.2**2 * SEEN)
    ground = rng.uniform(-1, extent - 1, (total, 2))
    points = np.concatenate([ground, rng.uniform(-RELIEF, 0, (total, 1))], 1)
    looking = _looking(centres, np.tile([1e-9, 0.0, -1.0], (count, 1)))
    return looking, points, np.concatenate([ground, np.full((total, 1), AWAY)], 1)


def _points(length: float) -> int:
    return round(length / 3.2 * SEEN)


def _turns(rng: np.random.Generator, count: int, deviation: float) -> Array:
    return so3_exp(torch.from_numpy(rng.normal(0, deviation, (count, 3)))).numpy()


def _looking(centres: Array, forward: Array) -> Array:
    """Poses [n, 4, 4] at centres [n, 3] that look along unit vectors [n, 3]."""
    up = np.where(np.abs(forward[:, 2:]) > 0.9, [0.0, 1.0, 0.0], [0.0, 0.0, 1.0])
    right = np.cross(forward, up)
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    poses = np.tile(np.eye(4), (len(centres), 1, 1))
    poses[:, :3, :3] = np.stack([right, np.cross(forward, right), forward], 2)
    poses[:, :3, 3] = centres
    return poses


def _observed(
    truth: Array, points: Array, near: Array, intrinsics: Intrinsics, rng: np.random.Generator
) -> Tracks:
    """Tracks of points in the photos that show them, from cameras within three units of a place `near` [p, 3]."""
    pairs = []
    for image, pose in enumerate(truth):
        close = np.flatnonzero(((near - pose[:3, 3]) ** 2).sum(1) < 9)
        in_cam = (points[close] - pose[:3, 3]) @ pose[:3, :3]
        xy = project(intrinsics, torch.full((len(close),), image), torch.from_numpy(in_cam)).numpy()
        shown = (in_cam[:, 2] > 0) & (xy >= 0).all(1) & (xy < SIZE).all(1)
        pairs.append(np.column_stack([close[shown], np.full(shown.sum(), image), xy[shown]]))
    rows = np.concatenate(pairs)
    rows = rows[np.lexsort((rows[:, 1], rows[:, 0]))]
    point, image = rows[:, :2].astype(np.int64).T
    kept = np.bincount(point, minlength=len(points))[point] > 1
    xy = rows[:, 2:] + rng.normal(0, NOISE_PX, (len(rows), 2))
    wrong = rng.uniform(size=len(rows)) < WRONG
    xy[wrong] = rng.uniform(0, SIZE, (wrong.sum(), 2))
    return Tracks(np.unique(point[kept], return_inverse=True)[1], image[kept], xy[kept])
