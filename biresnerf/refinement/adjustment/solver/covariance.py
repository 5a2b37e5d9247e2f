"""How exactly the cameras are known: the inverse of their information, in the frame that errors are measured in."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from biresnerf.arrays import Array
from biresnerf.geometry.rigid_bodies import RigidBodies
from biresnerf.refinement.adjustment.cameras import POSE, Cameras
from biresnerf.refinement.adjustment.lens.lenses import LENS
from biresnerf.refinement.adjustment.solver.blocks import Blocks
from biresnerf.refinement.adjustment.solver.body_motions import BodyMoves
from biresnerf.refinement.adjustment.solver.elimination import inverse_blocks

# What is known of any camera beside the evidence: a standard deviation of one radian and one spread of the rig. It
# keeps the system regular, and is far beyond what linear errors can mean.
NOTHING_KNOWN = 1.0
# Weight of the rotations in the alignment of a rig, beside its centres: it counts where these lie on a line.
ROTATIONS_WEIGHT = 1e-3


def covariance(
    cameras: Cameras,
    information: Blocks,
    lenses: NDArray[np.bool_] | None = None,
    aligned: NDArray[np.bool_] | None = None,
    bodies: RigidBodies | None = None,
) -> Array:
    """Covariances [n, 6, 6] of the cameras' rotation vectors (rad) and positions, along the world's axes.

    Turning, moving and scaling the whole rig changes no evidence. Errors are measured after the similarity that aligns
    the centres best, and so is the covariance: with H the centres' common motions, it is of the upper left block of the
    inverse of [[N, H], [H^T, 0]] (Triggs et al. 2000, section 9.3: inner constraints).

    Args:
        information: N, the normal equations of cameras and lenses without damping.
        lenses: which of the 8g unknowns of lenses may move; none where None.
        aligned: the cameras [n] whose centres count in the alignment; all where None.
        bodies: cameras that are fixed or move as one. The alignment uses the rotation, shift and scale that they leave
            free: none where two cameras are fixed, no scale where a body has several centres.
    """
    spread = float(np.sqrt(((cameras.centre - cameras.centre.mean(0)) ** 2).sum(1).mean())) or 1.0
    # Positions count in spreads of the rig.
    unit = np.r_[np.ones(3), np.full(3, spread)]
    of_lenses = np.ones(LENS * information.lenses)
    scaled = information.scaled(np.concatenate([np.tile(unit, len(cameras)), of_lenses]))
    counted = np.ones(len(cameras), np.bool_) if aligned is None else aligned
    in_spreads = Cameras(cameras.rotation, cameras.centre / spread)
    common = common_motions(in_spreads, counted)
    free = (False if lenses is None else lenses) & (scaled.diagonal[POSE * len(cameras) :] > 0)
    if bodies is None or not bodies.tied:
        found = _inverses(scaled, seen_aligning(common, counted), free)
    else:
        moves = BodyMoves.among(in_spreads, bodies)
        if not moves.bodies:  # all cameras are fixed
            return np.zeros((len(cameras), POSE, POSE))
        seen = seen_aligning(common @ moves.allowed(common), counted)
        held = moves.of_bodies(seen.reshape(len(cameras), POSE, -1)).reshape(POSE * moves.bodies, -1)
        of_body = _inverses(moves.reduced(scaled), held, free)
        found = np.zeros((len(cameras), POSE, POSE))
        moving = moves.of >= 0
        own = moves.columns[moving]
        found[moving] = own @ of_body[moves.of[moving]] @ own.transpose(0, 2, 1)
    return np.asarray((found + found.transpose(0, 2, 1)) / 2 * unit[:, None] * unit[None, :])


def _inverses(information: Blocks, common: Array, lenses: NDArray[np.bool_]) -> Array:
    """Each camera's covariance [n, 6, 6], of errors with no part along common motions [6n, m]; NaN where unknown."""
    poses, none = POSE * information.cameras, np.zeros(len(lenses))
    known = information.with_diagonal(np.concatenate([np.full(poses, 1 / NOTHING_KNOWN**2), none]))
    held = common * float(known.diagonal[:poses].mean())  # as large as the rest: only their directions count
    border = np.concatenate([held, np.zeros((len(lenses), held.shape[1]))])
    found = inverse_blocks(known, np.concatenate([np.ones(poses, np.bool_), lenses]), border)
    if found is None:
        return np.full((information.cameras, POSE, POSE), np.nan)
    return found[: information.cameras, :POSE, :POSE]


def common_motions(cameras: Cameras, counted: NDArray[np.bool_]) -> Array:
    """Increments [6n, 7] that turn, move and scale all cameras about the middle of some."""
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


def seen_aligning(motions: Array, counted: NDArray[np.bool_]) -> Array:
    """Orthonormal basis [6n, m or fewer] of common motions [6n, m] as an alignment of some cameras weighs them."""
    weight = counted[:, None] * np.r_[np.full(3, ROTATIONS_WEIGHT), np.ones(3)]
    basis, sizes, _ = np.linalg.svd(motions * weight.reshape(-1, 1), full_matrices=False)
    return np.asarray(basis[:, sizes > 1e-9 * sizes.max(initial=0.0)])
