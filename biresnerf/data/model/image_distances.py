"""How far images are from each other, some at a time: of ten thousand, all pairs at once would take gigabytes."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from biresnerf.geometry.focus import focus_point

# The distances [k, m] of k images to m images, both by index.
Distances = Callable[[NDArray[np.int64], NDArray[np.int64]], NDArray[np.floating]]
_AT_ONCE = 256
_TYPICAL = 1000  # images that say how far any two are apart


def pose_distances(world_from_cam: NDArray[np.float64]) -> Distances:
    """How far poses [n, 4, 4] are apart: their centres, in distances of the scene, and their viewing axes."""
    centres = world_from_cam[:, :3, 3] / max(focus_point(world_from_cam).mean_distance, 1e-12)
    axes = world_from_cam[:, :3, 2]
    return lambda some, others: _between(centres[some], centres[others]) + _between(axes[some], axes[others])


def _between(some: NDArray[np.float64], others: NDArray[np.float64]) -> NDArray[np.float64]:
    """Distances [k, m] between points [k, 3] and [m, 3]."""
    return np.asarray(np.sqrt(sum((a[:, None] - b) ** 2 for a, b in zip(some.T, others.T, strict=True))))


def nearest_pairs(apart: Distances, images: int, count: int) -> set[tuple[int, int]]:
    """Each of so many images with its ``count`` nearest."""
    nearest = nearest_images(apart, images, count)
    first, second = np.repeat(np.arange(images), nearest.shape[1]), nearest.ravel()
    low, high = np.minimum(first, second), np.maximum(first, second)
    return set(zip(low.tolist(), high.tolist(), strict=True))


def nearest_images(apart: Distances, images: int, count: int) -> NDArray[np.int64]:
    """Each of so many images' nearest others, the nearest first [images, count]; fewer if there are no more."""
    everyone = np.arange(images)
    found = np.zeros((images, min(count, images - 1)), np.int64)
    for rows in _blocks(everyone):
        distances = apart(rows, everyone)
        distances[np.arange(len(rows)), rows] = np.inf
        found[rows] = np.argsort(distances, axis=1, kind="stable")[:, : found.shape[1]]
    return found


def typical_distance(apart: Distances, images: int) -> float:
    """The median distance of any two images; of thousands, of any two of a thousand of them, evenly chosen."""
    chosen = np.arange(images)[:: -(-images // _TYPICAL)]
    found = [apart(rows, chosen)[rows[:, None] < chosen] for rows in _blocks(chosen)]
    return float(np.median(np.concatenate(found)))


def distances_in_order(apart: Distances, images: int) -> NDArray[np.float64]:
    """The distance [n - 1] of each image to the next."""
    found = [np.diagonal(apart(rows, rows + 1)) for rows in _blocks(np.arange(images - 1))]
    return np.concatenate(found).astype(np.float64)


def _blocks(images: NDArray[np.int64]) -> list[NDArray[np.int64]]:
    return np.split(images, range(_AT_ONCE, len(images), _AT_ONCE))
