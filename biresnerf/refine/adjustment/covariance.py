"""How exactly the cameras are known: the inverse of their information, in the frame that errors are measured in."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from biresnerf.refine.adjustment.cameras import POSE, Cameras

Array = NDArray[np.float64]

# What is known of any camera beside the evidence: a standard deviation of one radian and one spread of the rig. It
# keeps the system regular, and is far beyond what linear errors can mean.
NOTHING_KNOWN = 1.0
# Weight of the rotations in the alignment of a rig, beside its centres: it counts where these lie on a line.
ROTATIONS_WEIGHT = 1e-3


def covariance(cameras: Cameras, information: Array, aligned: NDArray[np.bool_] | None = None) -> Array:
    """Covariance [6n, 6n] of the cameras' rotation vectors (rad) and positions, along the world's axes.

    Turning, moving and scaling the whole rig changes no evidence. Errors are measured after the similarity that aligns
    the centres best, and so is the covariance: with H the centres' common motions, it is the upper left block of the
    inverse of [[N, H], [H^T, 0]] (Triggs et al. 2000, section 9.3: inner constraints).

    Args:
        information: N [6n, 6n], the cameras' normal equations without damping.
        aligned: the cameras [n] whose centres count in the alignment; all where None.
    """
    size = 6 * len(cameras)
    spread = float(np.sqrt(((cameras.centre - cameras.centre.mean(0)) ** 2).sum(1).mean())) or 1.0
    unit = np.tile(
        np.r_[np.ones(3), np.full(3, spread)], len(cameras)
    )  # positions count in spreads of the rig
    scaled = information * unit[:, None] * unit[None, :] + np.eye(size) / NOTHING_KNOWN**2
    common = _common_motions(cameras, spread, np.ones(len(cameras), np.bool_) if aligned is None else aligned)
    held = common * float(np.diagonal(scaled).mean())  # as large as the rest: only their directions count
    bordered = np.block([[scaled, held], [held.T, np.zeros((held.shape[1],) * 2)]])
    found = np.linalg.inv(bordered)[:size, :size]
    return np.asarray((found + found.T) / 2 * unit[:, None] * unit[None, :])


def without_lenses(information: Array, cameras: Cameras, free: NDArray[np.bool_]) -> Array:
    """The information [6n, 6n] of the poses, whatever the lenses are.

    Args:
        information: [6n + 3g, 6n + 3g], of poses and lenses, with what is known of lenses before.
        free: which of the 3g unknowns of lenses may move.
    """
    poses = POSE * len(cameras)
    moving = poses + np.flatnonzero(free)
    mixed, own = information[:poses, moving], information[np.ix_(moving, moving)]
    return np.asarray(information[:poses, :poses] - mixed @ np.linalg.pinv(own, hermitian=True) @ mixed.T)


def of_each(whole: Array) -> Array:
    """Each camera's own block [n, 6, 6] of a covariance [6n, 6n]."""
    n = len(whole) // 6
    return np.stack([whole[6 * i : 6 * i + 6, 6 * i : 6 * i + 6] for i in range(n)])


def largest_group(information: Array, count: int) -> NDArray[np.bool_]:
    """Which cameras [n] evidence ties together, directly or through others; of several groups the largest.

    Args:
        information: [6n or more, 6n or more], with the cameras first.
        count: n.
    """
    own = information[: POSE * count, : POSE * count].reshape(count, POSE, count, POSE)
    tied = (own != 0).any(axis=(1, 3)) | np.eye(count, dtype=np.bool_)
    group = np.arange(count)
    while True:
        joined = np.where(tied, group, count).min(1)
        if (joined == group).all():
            return np.asarray(group == np.bincount(group).argmax())
        group = joined


def _common_motions(cameras: Cameras, spread: float, aligned: NDArray[np.bool_]) -> Array:
    """Orthonormal basis [6n, 7 or fewer] of what turns, moves or scales the aligned cameras; positions in spreads."""
    n = len(cameras)
    if not aligned.any():
        return np.zeros((6 * n, 0))
    away = (cameras.centre - cameras.centre[aligned].mean(0)) / spread
    motions = np.zeros((n, 6, 7))
    for axis in range(3):
        unit = np.eye(3)[axis]
        motions[:, :3, axis] = ROTATIONS_WEIGHT * unit
        motions[:, 3:, axis] = np.cross(unit, away)
        motions[:, 3 + axis, 3 + axis] = 1.0
    motions[:, 3:, 6] = away
    motions[~aligned] = 0.0
    basis, sizes, _ = np.linalg.svd(motions.reshape(6 * n, 7), full_matrices=False)
    return np.asarray(basis[:, sizes > 1e-9 * sizes[0]])
