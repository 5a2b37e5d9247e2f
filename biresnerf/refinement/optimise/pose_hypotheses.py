"""Poses to try for a lost camera, in the frame of the optimised poses (scene centre at the origin)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from biresnerf.arrays import Array
from biresnerf.data.photos.area_resize import area_resize
from biresnerf.data.photos.images import ImageSet
from biresnerf.geometry.rigid import motion_of, rotation_of
from biresnerf.geometry.similarity import align_robust
from biresnerf.refinement.numbers.lost import LostNumbers

THUMBNAIL = 16  # px


def photo_distances(images: ImageSet) -> NDArray[np.float32]:
    """Root mean squared difference [n, n] of the photos where both count, each shrunk to at most 16 x 16 px."""
    width = min(THUMBNAIL, int(images.widths.min()))
    height = min(THUMBNAIL, int(images.heights.min()))
    small, weight = (
        np.stack(part)
        for part in zip(*(_thumbnail(images, i, width, height) for i in range(len(images))), strict=True)
    )
    weighed = small * weight
    squared = (weighed * small) @ weight.T + weight @ (weighed * small).T - 2 * weighed @ weighed.T
    return np.sqrt(np.maximum(squared / np.maximum(weight @ weight.T, 1e-6), 0))


def _thumbnail(images: ImageSet, index: int, width: int, height: int) -> tuple[NDArray, NDArray]:
    """Colours of an image, shrunk, 0 to 1 [width * height * 3], and how much of each counts."""
    photo, counts = images.image(index) / np.float32(255), images.counts_image(index)
    if counts is None:
        small = area_resize(photo, width, height).ravel()
        return small, np.ones_like(small)
    share = area_resize(counts[..., None].astype(np.float32), width, height)
    colour = area_resize(photo * counts[..., None], width, height) / np.maximum(share, 1e-6)
    return colour.ravel(), share.repeat(3, axis=2).ravel()


def pose_hypotheses(
    given: Array, now: Array, camera: int, trusted: NDArray[np.bool_], far: Array, numbers: LostNumbers
) -> Array:
    """Poses [h, 4, 4] that `camera` may have.

    Args:
        given: unit_from_cam [n, 4, 4] that the run started from.
        now: unit_from_cam [n, 4, 4] at present.
        camera: index of the lost one.
        trusted: mask [n] of cameras with a present pose that is believed.
        far: difference [n] of each photo from the camera's, see `photo_distances`.

    Returns:
        its pose as given (carried into the frame that the others have drifted to); that with the corrections of
        its neighbours, on orbits about the scene and rolled; places of cameras with similar photos; turned
        about in place and turned to look at the scene.
    """
    others = np.flatnonzero(trusted & (np.arange(len(now)) != camera))
    if len(others) == 0:
        start, carried = given[camera], given
    else:
        carried = align_robust(given[others], now[others], with_rotations=True).apply_to_poses(given)
        start = carried[camera]
    near = others[np.argsort(_apart(carried[others], start), kind="stable")[: numbers.neighbours]]
    alike = others[np.argsort(far[others], kind="stable")[: numbers.neighbours]]
    corrections = now[near] @ np.linalg.inv(carried[near])
    orbits, rolled = _orbits(start, numbers.orbits_deg), _rolled(start, numbers.rolls_deg)
    found = [start[None], corrections @ start, now[alike], orbits, rolled]
    half_turns = np.stack([np.diag([-1.0, 1, -1, 1]), np.diag([1.0, -1, -1, 1])])
    facing = _facing_centre(start)
    found += [start @ half_turns, facing[None], _rolled(facing, numbers.rolls_deg)]
    return np.concatenate(found)


def _apart(poses: Array, pose: Array) -> Array:
    """How far poses [m, 4, 4] are from one: centres relative to its distance from the scene, and viewing axes."""
    distance = max(float(np.linalg.norm(pose[:3, 3])), 1e-9)
    centres = np.linalg.norm(poses[:, :3, 3] - pose[:3, 3], axis=1) / distance
    return np.hypot(centres, np.linalg.norm(poses[:, :3, 2] - pose[:3, 2], axis=1))


def _orbits(pose: Array, orbits_deg: tuple[float, ...]) -> Array:
    """The camera turned about the origin: around its own horizontal and vertical axis, and around both."""
    angles = [sign * angle for angle in orbits_deg for sign in (-1, 1)]
    turns = [(a, 0) for a in angles] + [(0, a) for a in angles]
    turns += [(a, b) for a in (-20, 20) for b in (-20, 20)]
    return _turn(np.radians(turns) @ pose[:3, :2].T) @ pose


def _rolled(pose: Array, rolls_deg: tuple[float, ...]) -> Array:
    """The camera turned about its optical axis."""
    return pose @ _turn(np.radians(rolls_deg)[:, None] * np.array([0.0, 0, 1]))


def _facing_centre(pose: Array) -> Array:
    """The camera turned in place by the least angle that makes it look at the origin."""
    forward = -pose[:3, 3] / max(float(np.linalg.norm(pose[:3, 3])), 1e-9)
    axis = np.cross(pose[:3, 2], forward)
    sine, cosine = float(np.linalg.norm(axis)), float(pose[:3, 2] @ forward)
    axis = axis / sine if sine > 1e-6 else pose[:3, 1]
    turned = pose.copy()
    turned[:3, :3] = _turn(np.arctan2(sine, cosine) * axis)[:3, :3] @ pose[:3, :3]
    return turned


def _turn(rotvec: Array) -> Array:
    """Rotations about the origin as matrices [..., 4, 4] of rotation vectors [..., 3]."""
    return motion_of(rotation_of(rotvec))
