"""How exactly the cameras are known: the inverse of their information, points and scales eliminated."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from biresnerf.refine.adjustment.cameras import Cameras

Array = NDArray[np.float64]

RANK = 1e-13  # of the largest eigenvalue: what is smaller is rounding
UNKNOWN = 1e12  # variance, in the poses' units, of what no evidence fixes


def covariance(cameras: Cameras, information: Array, free: NDArray[np.bool_]) -> Array:
    """Covariance [n, 6, 6] of each camera's rotation vector (rad) and position, both along the world's axes.

    Turning, moving and scaling the whole rig changes no evidence but the prior; errors are measured after an alignment
    that removes these seven freedoms, and so they are removed from the covariance: it is that of the free network.

    Args:
        information: [6n, 6n], the cameras' normal equations without damping.
        free: which unknowns may move; the others have no variance.
    """
    n = len(cameras)
    spread = float(np.sqrt(((cameras.centre - cameras.centre.mean(0)) ** 2).sum(1).mean())) or 1.0
    unit = np.tile(np.r_[np.ones(3), np.full(3, spread)], n)  # positions count in spreads of the rig
    scaled = information * unit[:, None] * unit[None, :]
    common = _common_motions(cameras, spread) if free.all() else np.zeros((6 * n, 0))
    size = max(float(np.diagonal(scaled).mean()), 1e-300)
    across = np.eye(6 * n) - common @ common.T
    kept = across @ scaled @ across + size * common @ common.T  # as if known; taken out again below
    values, vectors = np.linalg.eigh(((kept + kept.T) / 2)[np.ix_(free, free)])
    least = RANK * float(values.max(initial=1e-300))
    variances = np.where(values > least, 1 / np.maximum(values, least), UNKNOWN)
    whole = np.zeros((6 * n, 6 * n))
    whole[np.ix_(free, free)] = (vectors * variances) @ vectors.T
    whole -= common @ common.T / size
    whole *= unit[:, None] * unit[None, :]
    return np.stack([whole[6 * i : 6 * i + 6, 6 * i : 6 * i + 6] for i in range(n)])


def _common_motions(cameras: Cameras, spread: float) -> Array:
    """Orthonormal basis [6n, 7] of increments that turn, move or scale the rig as a whole; positions in spreads."""
    n = len(cameras)
    away = (cameras.centre - cameras.centre.mean(0)) / spread
    motions = np.zeros((n, 6, 7))
    for axis in range(3):
        unit = np.eye(3)[axis]
        motions[:, :3, axis] = unit
        motions[:, 3:, axis] = np.cross(unit, away)
        motions[:, 3 + axis, 3 + axis] = 1.0
    motions[:, 3:, 6] = away
    basis, sizes, _ = np.linalg.svd(motions.reshape(6 * n, 7), full_matrices=False)
    return np.asarray(basis[:, sizes > 1e-9 * sizes[0]])
