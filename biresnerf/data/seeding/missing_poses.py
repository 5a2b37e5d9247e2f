"""Poses for images that no feature matches placed: guesses from the images around them, each named for what it is."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from biresnerf.data.model.image_order import natural_order, taken_along_a_path
from biresnerf.geometry.rigid import interpolate_pose
from biresnerf.report import PoseSource

WIDEST_GAP = 6  # images from one known pose to the next that are still taken for a path
FARTHEST = 3  # images beyond the end of a path that still take its last pose


def guess_missing(
    world_from_cam: NDArray[np.float64],
    known: NDArray[np.bool_],
    names: Sequence[str],
    matches: NDArray[np.int64],
    likeness: Callable[[], NDArray[np.float32]],
) -> list[PoseSource | None]:
    """Fills poses [n, 4, 4] that are not ``known`` [n], in place; says how, None for known ones.

    ``neighbours``: where names tell the order of a path, between the poses before and after it; near its ends, the
    last one. ``nearest-view``: the pose of the image with which it shares most features, or else that looks most
    alike.

    Args:
        matches: how many features [n, n] any two images have in common.
        likeness: called only if it is needed; see `image_likeness.likeness`.

    Raises:
        ValueError: no pose is known.
    """
    if not known.any():
        raise ValueError("no pose is known to guess others from")
    sources: list[PoseSource | None] = [None] * len(known)
    order = natural_order(names)
    on_path = taken_along_a_path(world_from_cam[[i for i in order if known[i]]])
    alike: NDArray[np.float32] | None = None
    for place, image in enumerate(order):
        if known[image]:
            continue
        pose = _on_path(world_from_cam, known, order, place) if on_path else None
        sources[image] = "neighbours"
        if pose is None:
            shared = np.where(known, matches[image], 0)
            if shared.max() > 0:
                nearest = int(np.argmax(shared))
            else:
                alike = likeness() if alike is None else alike
                nearest = int(np.argmax(np.where(known, alike[image], -np.inf)))
            pose, sources[image] = world_from_cam[nearest].copy(), "nearest-view"
        world_from_cam[image] = pose
    return sources


def _on_path(
    world_from_cam: NDArray[np.float64], known: NDArray[np.bool_], order: list[int], place: int
) -> NDArray[np.float64] | None:
    before = next((p for p in range(place - 1, -1, -1) if known[order[p]]), None)
    after = next((p for p in range(place + 1, len(order)) if known[order[p]]), None)
    if before is not None and after is not None and after - before <= WIDEST_GAP:
        share = (place - before) / (after - before)
        return interpolate_pose(world_from_cam[order[before]], world_from_cam[order[after]], share)
    ends = [p for p in (before, after) if p is not None and abs(p - place) <= FARTHEST]
    if not ends:
        return None
    nearest = min(ends, key=lambda p: abs(p - place))
    pose: NDArray[np.float64] = world_from_cam[order[nearest]].copy()
    return pose
