"""Measured positions of cameras as a term of the adjustment, in a frame of their own."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from biresnerf.geometry.body_offset import SHARED_ERRORS
from biresnerf.geometry.earth.georeference import NORMAL_MEDIAN
from biresnerf.geometry.similarity import align_robust
from biresnerf.refinement.adjustment.cameras import POSE, Cameras
from biresnerf.refinement.adjustment.evidence import Positions
from biresnerf.refinement.adjustment.solver.term import Linearised
from biresnerf.refinement.adjustment.track_term import ROBUST_SCALE

Array = NDArray[np.float64]

FINEST_M = 1e-3  # no position is as exact
CLEAR = 3.0  # standard deviations of a noise level, beyond which two differ


class PositionTerm:
    """How far cameras are from where they were measured, in standard deviations.

    The similarity that carries cameras to the positions is found anew with each measurement of the noise, so that
    frame and scale stay free. Stated deviations grow with the residuals: where all contradict them, none is believed.

    Attributes:
        noise: of the residuals, in the deviations that are stated, and one at least; in metres where none are.
    """

    def __init__(self, positions: Positions, cameras: Cameras) -> None:
        self.unknowns = np.zeros(0)
        self._positions = positions
        self.noise = 1.0
        self.measure(cameras)

    def measure(self, cameras: Cameras) -> float:
        image, there = self._positions.image, np.tile(np.eye(4), (len(self._positions.image), 1, 1))
        there[:, :3, 3] = self._positions.metres
        metres_from_world = align_robust(cameras.world_from_cam()[image], there)
        self._at = metres_from_world.inverse().apply(self._positions.metres)
        turn = metres_from_world.scale * metres_from_world.rotation
        self._whitened = turn / self._positions.deviation[:, :, None]
        level = float(np.median(np.linalg.norm(self._residuals(cameras), axis=1))) / NORMAL_MEDIAN
        # Errors that photos share, as a receiver's drift, do not average out.
        before, self.noise = self.noise, max(level, 1.0)
        if not self._positions.stated:
            self.noise = max(SHARED_ERRORS * level, FINEST_M)
        return abs(self.noise / before - 1)

    def cost(self, cameras: Cameras, unknowns: Array) -> float:
        square = self.squares(cameras)
        return float((ROBUST_SCALE**2 * square / (ROBUST_SCALE**2 + square)).sum())

    def squares(self, cameras: Cameras, noise: float | None = None) -> Array:
        """Squared distances [m] from the positions, in noise levels."""
        return np.asarray((self._residuals(cameras) ** 2).sum(1) / (noise or self.noise) ** 2)

    def linearise(self, cameras: Cameras, damping: float) -> Linearised:
        residual = self._residuals(cameras)
        weight = (ROBUST_SCALE**2 / (ROBUST_SCALE**2 + self.squares(cameras)) / self.noise) ** 2
        system, right = np.zeros((cameras.unknowns,) * 2), np.zeros(cameras.unknowns)
        rows = POSE * self._positions.image[:, None] + np.arange(3, 6)
        own = np.einsum("m,mka,mkb->mab", weight, self._whitened, self._whitened)
        np.add.at(system, (rows[:, :, None], rows[:, None, :]), own)
        np.add.at(right, rows, np.einsum("m,mka,mk->ma", weight, self._whitened, residual))
        return Linearised(system, right, ())

    def stepped(self, linearised: Linearised, motion: Array) -> Array:
        return self.unknowns

    def _residuals(self, cameras: Cameras) -> Array:
        """[m, 3]."""
        away = cameras.centre[self._positions.image] - self._at
        return np.einsum("mka,ma->mk", self._whitened, away)


def position_misfits(poses: Array, positions: Positions) -> tuple[Array, NDArray[np.bool_]]:
    """How badly sets of poses [c, n, 4, 4] fit measured positions, and which fit them as well as the best one.

    Returns the robust squares [c, m] in noise levels of the best, and bool [c].
    """
    rigs = [Cameras.of(each) for each in poses]
    terms = [PositionTerm(positions, each) for each in rigs]
    noise = np.array([term.noise for term in terms])
    square = np.stack([t.squares(c, float(noise.min())) for t, c in zip(terms, rigs, strict=True)])
    chance = 1 + CLEAR / (2 * positions.metres.size) ** 0.5
    return ROBUST_SCALE**2 * square / (ROBUST_SCALE**2 + square), noise < chance * noise.min()
