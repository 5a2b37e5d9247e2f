"""How exactly the cameras are known: the inverse of their information, in the frame that errors are measured in."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from biresnerf.arrays import Array
from biresnerf.geometry.rigid_bodies import RigidBodies
from biresnerf.refinement.adjustment.cameras import POSE, Cameras
from biresnerf.refinement.adjustment.solver.body_motions import allowed_motions, body_columns

# What is known of any camera beside the evidence: a standard deviation of one radian and one spread of the rig. It
# keeps the system regular, and is far beyond what linear errors can mean.
NOTHING_KNOWN = 1.0
# Weight of the rotations in the alignment of a rig, beside its centres: it counts where these lie on a line.
ROTATIONS_WEIGHT = 1e-3


def covariance(
    cameras: Cameras,
    information: Array,
    aligned: NDArray[np.bool_] | None = None,
    bodies: RigidBodies | None = None,
) -> Array:
    """Covariance [6n, 6n] of the cameras' rotation vectors (rad) and positions, along the world's axes.

    Turning, moving and scaling the whole rig changes no evidence. Errors are measured after the similarity that aligns
    the centres best, and so is the covariance: with H the centres' common motions, it is the upper left block of the
    inverse of [[N, H], [H^T, 0]] (Triggs et al. 2000, section 9.3: inner constraints).

    Args:
        information: N [6n, 6n], the cameras' normal equations without damping.
        aligned: the cameras [n] whose centres count in the alignment; all where None.
        bodies: cameras that are fixed or move as one. The alignment is by what they leave of turning, moving and
            scaling: nothing where two cameras are fixed, no scale where a body has several centres.
    """
    spread = float(np.sqrt(((cameras.centre - cameras.centre.mean(0)) ** 2).sum(1).mean())) or 1.0
    # Positions count in spreads of the rig.
    unit = np.tile(np.r_[np.ones(3), np.full(3, spread)], len(cameras))
    scaled = information * unit[:, None] * unit[None, :]
    counted = np.ones(len(cameras), np.bool_) if aligned is None else aligned
    in_spreads = Cameras(cameras.rotation, cameras.centre / spread)
    common = _common_motions(in_spreads, counted)
    if bodies is None or not bodies.tied:
        found = _inverse(scaled, _seen_aligning(common, counted))
    else:
        moves = body_columns(in_spreads, bodies)
        seen = _seen_aligning(common @ allowed_motions(moves, common), counted)
        found = moves @ _inverse(moves.T @ scaled @ moves, moves.T @ seen) @ moves.T
    return np.asarray((found + found.T) / 2 * unit[:, None] * unit[None, :])


def _inverse(information: Array, common: Array) -> Array:
    """Of [k, k], where errors have no part along common motions [k, m]."""
    size = len(information)
    known = information + np.eye(size) / NOTHING_KNOWN**2
    held = common * float(np.diagonal(known).mean())  # as large as the rest: only their directions count
    bordered = np.block([[known, held], [held.T, np.zeros((held.shape[1],) * 2)]])
    return np.asarray(np.linalg.inv(bordered)[:size, :size])


def without_lenses(information: Array, cameras: Cameras, free: NDArray[np.bool_]) -> Array:
    """The information [6n, 6n] of the poses, whatever the lenses are.

    Args:
        information: [6n + 8g, 6n + 8g], of poses and lenses, with what is known of lenses before.
        free: which of the 8g unknowns of lenses may move.
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


def _common_motions(cameras: Cameras, counted: NDArray[np.bool_]) -> Array:
    """What turns, moves and scales all cameras [6n, 7], about the middle of some."""
    n = len(cameras)
    away = cameras.centre - (cameras.centre[counted].mean(0) if counted.any() else 0.0)
    motions = np.zeros((n, 6, 7))
    for axis in range(3):
        unit = np.eye(3)[axis]
        motions[:, :3, axis] = unit
        motions[:, 3:, axis] = np.cross(unit, away)
        motions[:, 3 + axis, 3 + axis] = 1.0
    motions[:, 3:, 6] = away
    return motions.reshape(6 * n, 7)


def _seen_aligning(motions: Array, counted: NDArray[np.bool_]) -> Array:
    """Orthonormal basis [6n, m or fewer] of common motions [6n, m] as an alignment of some cameras weighs them."""
    weight = counted[:, None] * np.r_[np.full(3, ROTATIONS_WEIGHT), np.ones(3)]
    basis, sizes, _ = np.linalg.svd(motions * weight.reshape(-1, 1), full_matrices=False)
    return np.asarray(basis[:, sizes > 1e-9 * sizes.max(initial=0.0)])
