"""Measured places of cameras and of control points as terms of the adjustment, in a separate frame."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from biresnerf.arrays import Array
from biresnerf.data.points.located_points import MOST_FAR_OFF, far_off
from biresnerf.geometry.body_offset import SHARED_ERRORS
from biresnerf.geometry.camera.camera import Intrinsics
from biresnerf.geometry.earth.georeference import NORMAL_MEDIAN
from biresnerf.geometry.similarity import Similarity, align_points
from biresnerf.judging.compare import MEASURED, compare
from biresnerf.refinement.adjustment.cameras import POSE, Cameras
from biresnerf.refinement.adjustment.evidence import Control, Evidence, Positions
from biresnerf.refinement.adjustment.solver.blocks import Blocks
from biresnerf.refinement.adjustment.solver.term import Linearised
from biresnerf.refinement.adjustment.track_term import RAYLEIGH_MEDIAN, ROBUST_SCALE, TrackTerm

FINEST_M = 1e-3  # no position is as exact
MARKED_PX = 0.5  # points in photos are not marked more exactly
SETTLING = 3  # measurements of a noise level for cameras that stay
DIMENSIONS = {"positions": 3, "control": 2}  # of a residual


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
        metres_from_world = align_points(cameras.centre[self._positions.image], self._positions.metres)
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
        own, right = np.zeros((len(weight), POSE, POSE)), np.zeros(cameras.unknowns)
        own[:, 3:, 3:] = np.einsum("m,mka,mkb->mab", weight, self._whitened, self._whitened)
        system = Blocks.of_cameras(cameras, self._positions.image, own)
        rows = POSE * self._positions.image[:, None] + np.arange(3, 6)
        np.add.at(right, rows, np.einsum("m,mka,mk->ma", weight, self._whitened, residual))
        return Linearised(system, right, ())

    def stepped(self, linearised: Linearised, motion: Array) -> Array:
        return self.unknowns

    def _residuals(self, cameras: Cameras) -> Array:
        """[m, 3]."""
        away = cameras.centre[self._positions.image] - self._at
        return np.einsum("mka,ma->mk", self._whitened, away)


class ControlTerm(TrackTerm):
    """Reprojections of points at measured coordinates, which have errors themselves.

    The similarity between both frames is found anew with each measurement of the noise, so that frame and scale stay
    free; the noise level starts from the points' distances from their marks.

    Attributes:
        far_off: bool [p], points that contradict the photos by what the last measurement found.
    """

    def __init__(self, control: Control, intrinsics: Intrinsics, cameras: Cameras) -> None:
        super().__init__(control.tracks, intrinsics, cameras)
        self._control, self._free = control, self.unknowns

    def measure(self, cameras: Cameras) -> float:
        self.known[:] = 0.0
        self.unknowns = self._free
        self.settle(cameras)
        self._free = self.unknowns.copy()
        metres_from_world = align_points(self._free, self._control.metres)
        self.place = metres_from_world.inverse().apply(self._control.metres)
        whitened = metres_from_world.scale * metres_from_world.rotation / self._control.deviation[:, :, None]
        self.far_off = self._far_off(cameras, metres_from_world)
        self.known = np.einsum("pka,pkb->pab", whitened, whitened)
        self.unknowns = self.place.copy()
        return super().measure(cameras)

    def _far_off(self, cameras: Cameras, metres_from_world: Similarity) -> NDArray[np.bool_]:
        apart_m = np.linalg.norm(metres_from_world.apply(self._free) - self._control.metres, axis=1)
        away = np.linalg.norm(self._free[self.point] - cameras.centre[self.image], axis=1)
        px = away / self.lens[self.image, 0]
        px_m = metres_from_world.scale * np.bincount(self.point, px) / np.bincount(self.point)
        return far_off(apart_m, px_m, self._control.deviation)

    def _measured_noise(self, cameras: Cameras) -> float:
        level = float(np.median(self.errors_px(cameras))) / RAYLEIGH_MEDIAN
        return max(level, MARKED_PX) if np.isfinite(level) else self.noise_px

    @property
    def noise(self) -> float:
        """The noise of the observations, px."""
        return self.noise_px

    def squares(self, cameras: Cameras, noise: float | None = None) -> Array:
        """Squared reprojection errors [m], in noise levels."""
        return np.asarray((self.errors_px(cameras) / (noise or self.noise_px)) ** 2)


def measured_terms(evidence: Evidence, cameras: Cameras) -> dict[str, PositionTerm | ControlTerm]:
    """The terms of what was measured, by its kind."""
    found: dict[str, PositionTerm | ControlTerm] = {}
    if evidence.positions is not None:
        found["positions"] = PositionTerm(evidence.positions, cameras)
    if evidence.control is not None:
        found["control"] = ControlTerm(evidence.control, evidence.intrinsics, cameras)
    return found


def control_believed(evidence: Evidence, cameras: Cameras) -> bool:
    """Whether most control points agree with photos from cameras that were adjusted to them."""
    if evidence.control is None:
        return True
    far = ControlTerm(evidence.control, evidence.intrinsics, cameras)
    far.measure(cameras)
    return bool(far.far_off.mean() <= MOST_FAR_OFF)


def measured_misfits(rigs: Sequence[tuple[Cameras, Evidence]]) -> dict[str, tuple[Array, NDArray[np.bool_]]]:
    """How badly sets of cameras fit what was measured, and which fit it as well as the best one, within chance.

    Returns for each kind the robust squares [c, m] in noise levels of the best, and bool [c].
    """
    terms = [(measured_terms(evidence, cameras), cameras) for cameras, evidence in rigs]
    found = {}
    for kind in terms[0][0]:
        for each, cameras in terms:
            for _ in range(SETTLING):
                each[kind].measure(cameras)
        noise = np.array([each[kind].noise for each, _ in terms])
        square = np.stack([each[kind].squares(cameras, float(noise.min())) for each, cameras in terms])
        behind = (1 - noise / noise.min()) * (2 * DIMENSIONS[kind] * square.shape[1]) ** 0.5
        robust = 1 / (1 / ROBUST_SCALE**2 + 1 / np.clip(square, 1e-300, 1e300))
        as_well = [compare(float(gain), MEASURED).finding == "same" for gain in behind]
        found[kind] = robust, np.array(as_well)
    return found
