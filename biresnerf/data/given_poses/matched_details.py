"""Details that pairs of photos share, found in small grey pictures: enough to tell right poses from wrong ones.

Corners (Shi and Tomasi 1994) are compared by their surroundings, which must be alike, and like no others (Lowe 2004).
These do not turn with the photo, so pairs whose photos are held differently have none: COLMAP's features find those.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from biresnerf.data.model.dataset import Dataset
from biresnerf.data.photos.images import load_images
from biresnerf.geometry.camera.pixel_rays import rays_of_pixels

SIDE = 320  # px that photos are shrunk to
PHOTOS, RUNS = 24, 4  # that are looked at, in runs of neighbours: photos of one walk share details with these
CORNERS = 250  # of a photo
PAIRS, LEAST = 60, 8  # pairs with most details in common, each with at least so many
# Px from a corner to the edge of what it is compared by, and between two of its samples.
_REACH, _SPACING = 12, 3
_FLAT = 1.0  # corners whose weaker gradient, squared, is below this are noise; of 255²
_ALIKE, _DISTINCT = 0.8, 0.85  # correlation, and distance as a share of that to the next one


@dataclass(frozen=True, eq=False)
class MatchedPair:
    """Directions in cam, float64 [m, 3], of what frames ``first`` and ``second`` (rows of the set) both show.

    ``tolerance`` is what a twentieth of the photos' long side is as an angle, rad.
    """

    first: int
    second: int
    in_first: NDArray[np.float64]
    in_second: NDArray[np.float64]
    tolerance: float


def matched_pairs(dataset: Dataset) -> list[MatchedPair]:
    """Pairs of photos with given poses that have most in common. Raises `InputError` as `load_images` does."""
    posed = np.flatnonzero(dataset.posed)
    rows = posed[_looked_at(len(posed))]
    if len(rows) < 2:
        return []
    images = load_images(replace(dataset, frames=tuple(dataset.frames[row] for row in rows)), SIDE)
    corners = [_corners(images.image(k).mean(axis=2)) for k in range(len(rows))]
    lenses = [camera.full() for camera in images.cameras]
    rays = [rays_of_pixels(lens, xy) for lens, (xy, _) in zip(lenses, corners, strict=True)]
    tolerances = [float(np.arctan(0.05 * max(c.width, c.height) / c.full().fx)) for c in images.cameras]

    def pairs() -> Iterator[MatchedPair]:
        for i, j in combinations(range(len(rows)), 2):
            a, b = _matches(corners[i][1], corners[j][1])
            if len(a) >= LEAST:
                tolerance = max(tolerances[i], tolerances[j])
                yield MatchedPair(int(rows[i]), int(rows[j]), rays[i][a], rays[j][b], tolerance)

    return sorted(pairs(), key=lambda pair: -len(pair.in_first))[:PAIRS]


def _looked_at(count: int) -> NDArray[np.int64]:
    if count <= PHOTOS:
        return np.arange(count)
    each = PHOTOS // RUNS
    starts = np.linspace(0, count - each, RUNS).round().astype(np.int64)
    return np.unique(starts[:, None] + np.arange(each))


def _corners(photo: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float32]]:
    """Positions of corners [m, 2], px, and the brightness around each, normalised [m, 64], of a photo [h, w]."""
    if min(photo.shape) <= 2 * _REACH:
        return np.zeros((0, 2)), np.zeros((0, 1), np.float32)
    grey = _blurred(photo.astype(np.float32), 1)
    down, right = (np.asarray(part, np.float32) for part in np.gradient(grey))
    xx, xy, yy = _blurred(right * right, 3), _blurred(right * down, 3), _blurred(down * down, 3)
    strength = (xx + yy) / 2 - np.hypot((xx - yy) / 2, xy)
    inner = np.zeros_like(strength)
    middle = (slice(_REACH, -_REACH), slice(_REACH, -_REACH))
    inner[middle] = strength[middle]
    highest = sliding_window_view(np.pad(inner, 3), (7, 7)).max(axis=(2, 3))
    y, x = np.nonzero((inner == highest) & (inner > _FLAT))
    strongest = np.argsort(-inner[y, x], kind="stable")[:CORNERS]
    y, x = y[strongest], x[strongest]
    around = np.arange(1 - _REACH, _REACH, _SPACING)
    seen = grey[y[:, None, None] + around[:, None], x[:, None, None] + around].reshape(
        len(y), len(around) ** 2
    )
    seen = seen - seen.mean(axis=1, keepdims=True)
    seen /= np.maximum(np.linalg.norm(seen, axis=1, keepdims=True), 1e-6)
    return np.stack([x + 0.5, y + 0.5], axis=1), seen


def _blurred(picture: NDArray[np.float32], reach: int) -> NDArray[np.float32]:
    """Means over squares of 2 ``reach`` + 1 px."""
    for axis in (0, 1):
        padding = [(reach, reach) if one == axis else (0, 0) for one in (0, 1)]
        padded = np.pad(picture, padding, mode="edge")
        picture = sliding_window_view(padded, 2 * reach + 1, axis=axis).mean(axis=-1, dtype=np.float32)
    return picture


def _matches(a: NDArray[np.float32], b: NDArray[np.float32]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Rows of ``a`` [m, 64] and ``b`` [k, 64] that are each other's nearest, alike, and unlike the next nearest."""
    if min(len(a), len(b)) < 2:
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    alike = a @ b.T
    own, nearest = np.arange(len(a)), alike.argmax(axis=1)
    best = alike[own, nearest]
    mutual = alike.argmax(axis=0)[nearest] == own
    alike[own, nearest] = -1.0
    good = mutual & (best > _ALIKE) & (1 - best < _DISTINCT**2 * (1 - alike.max(axis=1)))
    return own[good], nearest[good]


def off_by(
    first: NDArray[np.float64],
    second: NDArray[np.float64],
    in_first: NDArray[np.float64],
    in_second: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Angles [m], rad, between what one camera sees in directions [m, 3], and where the other camera may see it.

    That is anywhere on the arc from the other camera (a point at no distance) to the direction itself (infinitely far).
    Poses are ``world_from_cam``, [4, 4] or one for each direction [m, 4, 4].
    """
    far, seen = (
        (pose[..., :3, :3] @ direction[:, :, None])[:, :, 0]
        for pose, direction in ((first, in_first), (second, in_second))
    )
    baseline = first[..., :3, 3] - second[..., :3, 3]
    length = np.linalg.norm(baseline, axis=-1, keepdims=True)
    near = np.broadcast_to(baseline / np.maximum(length, 1e-300), far.shape)
    normal = np.cross(near, far)
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
    across = (seen * normal).sum(axis=1)
    along = seen - across[:, None] * normal
    beside = ((np.cross(near, along) * normal).sum(axis=1) >= 0) & (
        (np.cross(along, far) * normal).sum(axis=1) >= 0
    )
    on_arc = np.arcsin(np.clip(np.abs(across), 0.0, 1.0))
    to_far = _angle(seen, far)
    found = np.where(beside, on_arc, np.minimum(to_far, _angle(seen, near)))
    return np.where(length[..., 0] > 0, found, to_far)


def _angle(a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.arccos(np.clip((a * b).sum(axis=1), -1.0, 1.0))
