"""Poses for images that no feature matches placed: measured, or guesses from the images around them."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from biresnerf.data.model.image_distances import Distances
from biresnerf.data.model.image_order import natural_order, taken_along_a_path
from biresnerf.data.model.measured_places import PositionPriors
from biresnerf.geometry.body_offset import MAXWELL_MEDIAN, tie
from biresnerf.geometry.earth.georeference import MOST_SCATTER, MOST_TURNED_DEG, not_far_off
from biresnerf.geometry.focus import rms_spread
from biresnerf.geometry.rigid import interpolate_pose, motion_of
from biresnerf.report import PoseSource

WIDEST_GAP = 6  # images from one known pose to the next that are still taken for a path
FARTHEST = 3  # images beyond the end of a path that still take its last pose
LEAST_TIED = 3  # cameras that give the frame of measured poses


def fill_measured(
    world_from_cam: NDArray[np.float64], known: NDArray[np.bool_], priors: PositionPriors | None
) -> NDArray[np.bool_]:
    """Fills poses [n, 4, 4] that are not ``known`` [n] by GPS and a drone's gimbal, in place; says which [n].

    Known cameras give the frame of these, and how the camera is mounted: an offset that all share (`tie`). Where none
    is known, poses are in the frame of the positions, and the camera looks where the gimbal says. None is filled where
    known cameras contradict the measurements, or are fewer than `LEAST_TIED`.
    """
    filled = np.zeros(len(known), dtype=np.bool_)
    if priors is None or priors.rotations is None:
        return filled
    told = priors.turned & not_far_off(priors.positions_m)
    rows, measured = priors.rows[told], motion_of(priors.rotations[told], priors.positions_m[told])
    tied, new = known[rows], ~known[rows]
    found = measured
    if known.any():
        if not new.any() or tied.sum() < LEAST_TIED:
            return filled
        both = tie(world_from_cam[rows[tied]], measured[tied])
        spread = rms_spread(measured[tied, :3, 3])
        turned_deg = float(np.degrees(both.rotation * MAXWELL_MEDIAN))
        if turned_deg > MOST_TURNED_DEG or both.position * MAXWELL_MEDIAN > MOST_SCATTER * spread:
            return filled
        mounted = np.eye(4) if both.offset is None else both.offset.body_from_cam
        found = both.given_from_fitted.inverse().apply_to_poses(measured @ mounted)
    world_from_cam[rows[new]], filled[rows[new]] = found[new], True
    return filled


def guess_missing(
    world_from_cam: NDArray[np.float64],
    known: NDArray[np.bool_],
    names: Sequence[str],
    matches: NDArray[np.int64],
    unlikeness: Callable[[], Distances],
) -> list[PoseSource | None]:
    """Fills poses [n, 4, 4] that are not ``known`` [n], in place; says how, None for known ones.

    ``neighbours``: where names tell the order of a path, between the poses before and after it; near its ends, the
    last one. ``nearest-view``: the pose of the image with which it shares most features, or else that looks most
    alike.

    Args:
        matches: pairs of images, and how many features they have in common [m, 3].
        unlikeness: called only if it is needed; see `image_likeness.unlikeness`.

    Raises:
        ValueError: no pose is known.
    """
    if not known.any():
        raise ValueError("no pose is known to guess others from")
    sources: list[PoseSource | None] = [None] * len(known)
    if known.all():
        return sources
    order = natural_order(names)
    on_path = taken_along_a_path(world_from_cam[[i for i in order if known[i]]])
    unlike: Distances | None = None
    for place, image in enumerate(order):
        if known[image]:
            continue
        pose = _on_path(world_from_cam, known, order, place) if on_path else None
        sources[image] = "neighbours"
        if pose is None:
            shared = np.where(known, _in_common(image, matches, len(known)), 0)
            if shared.max() > 0:
                nearest = int(np.argmax(shared))
            else:
                unlike = unlike or unlikeness()
                others = np.flatnonzero(known)
                nearest = int(others[unlike(np.array([image]), others)[0].argmin()])
            pose, sources[image] = world_from_cam[nearest].copy(), "nearest-view"
        world_from_cam[image] = pose
    return sources


def _in_common(image: int, matches: NDArray[np.int64], images: int) -> NDArray[np.int64]:
    """How many features an image has in common with each other one [n]."""
    found = np.zeros(images, np.int64)
    for own, other in ((0, 1), (1, 0)):
        of_image = matches[matches[:, own] == image]
        found[of_image[:, other]] = of_image[:, 2]
    return found


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
