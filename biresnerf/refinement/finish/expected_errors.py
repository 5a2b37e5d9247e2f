"""How far poses may be from the truth: the covariance of the poses that the evidence prefers, and the way to them."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from biresnerf.arrays import Array
from biresnerf.geometry.rigid_bodies import RigidBodies
from biresnerf.geometry.similarity import Similarity, align_by_spread
from biresnerf.refinement.adjustment.adjustment import patch_term, track_term
from biresnerf.refinement.adjustment.cameras import Cameras
from biresnerf.refinement.adjustment.evidence import Evidence
from biresnerf.refinement.adjustment.measured_terms import measured_terms
from biresnerf.refinement.adjustment.solver.blocks import Blocks
from biresnerf.refinement.adjustment.solver.covariance import covariance
from biresnerf.refinement.adjustment.solver.elimination import largest_group
from biresnerf.refinement.adjustment.solver.solve import ROUNDS, SETTLED

NORMAL_90 = 1.2816  # of a normal deviate: one in ten is above it


@dataclass(frozen=True, eq=False)
class ExpectedErrors:
    """The errors of poses by the evidence: normal deviates about a mean.

    Increments are of the rotation vector (rad) and position (the poses' unit) that lead to the truth, along the world's
    axes; NaN where the evidence does not say.

    Attributes:
        away: their means [n, 6].
        covariance: [n, 6, 6], about the mean.
        by_tracks, by_patches: bool [n], whether a camera has such evidence.
    """

    away: Array
    covariance: Array
    by_tracks: NDArray[np.bool_]
    by_patches: NDArray[np.bool_]

    @property
    def known(self) -> NDArray[np.bool_]:
        return np.isfinite(self.away[:, 0])

    @property
    def moments(self) -> Array:
        """Mean squares of the errors [n, 6, 6]."""
        return np.asarray(self.covariance + self.away[:, :, None] * self.away[:, None, :])

    @property
    def deviations(self) -> float:
        """The median camera's distance from its preferred pose, in standard deviations.

        Infinite where most are unknown: the evidence does not say, or cameras are too far away.
        """
        deviation = np.sqrt(np.diagonal(self.covariance, axis1=1, axis2=2))
        fixed = (deviation == 0).all(1)
        squares = np.full(len(self.away), np.inf)
        for i in np.flatnonzero(self.known & ~fixed):
            away, scale = self.away[i] / deviation[i], np.outer(deviation[i], deviation[i])
            squares[i] = away @ np.linalg.pinv(self.covariance[i] / scale, hermitian=True) @ away / len(away)
        told = (self.by_tracks | self.by_patches) & ~fixed
        return float(np.sqrt(np.median(squares[told]))) if told.any() else np.inf

    def bounds_90(self) -> tuple[Array, Array]:
        """Bounds of nine in ten errors, of the rotation (rad) and the position, [n] each."""
        turned, shifted = (
            bound_90(self.moments[:, part, part], self.away[:, part]) for part in (slice(3), slice(3, 6))
        )
        return turned, shifted

    def carried(self, b_from_a: Similarity) -> ExpectedErrors:
        """The same in b, of poses that are in a here."""
        turn = _turn(b_from_a)
        return replace(self, away=self.away @ turn.T, covariance=turn @ self.covariance @ turn.T)


def expected_errors(
    world_from_cam: Array,
    preferred: Array,
    evidence: Evidence,
    patch_noise: float = 1.0,
    bodies: RigidBodies | None = None,
) -> ExpectedErrors:
    """Errors of poses [n, 4, 4]: the covariance of those that the evidence prefers [n, 4, 4], and the way to them.

    Args:
        evidence: in the frame of the preferred poses, which were adjusted to it; its lenses as found, with what was
            known of them before.
        patch_noise: level of the patches' noise, as the adjustment found it.
        bodies: cameras that are fixed or move as one; they say what of the frame is free.
    """
    cameras, lenses, numbers = Cameras.of(preferred, evidence.lenses), evidence.lenses, evidence.numbers
    n = len(cameras)
    by_tracks, by_patches = np.zeros(n, np.bool_), np.zeros(n, np.bool_)
    information = Blocks.nothing(cameras)
    tracks, patches = track_term(cameras, evidence, None), patch_term(cameras, evidence, patch_noise)
    if tracks is not None:
        for _ in range(ROUNDS):
            if tracks.measure(cameras) < SETTLED:
                break
        by_tracks[tracks.image] = True
        information += tracks.linearise(cameras, 0.0).system * numbers.track_model_error**-2
    if patches is not None:
        patches.settle(cameras)
        by_patches[patches.patches.target] = by_patches[patches.patches.host] = True
        information += patches.linearise(cameras, 0.0).system * numbers.patch_model_error**-2
    for term in measured_terms(evidence, cameras).values() if information.values.any() else ():
        term.measure(cameras)
        information += term.linearise(cameras, 0.0).system
    # Photos of another scene match each other, but say nothing of where the others stand.
    together, free = largest_group(information), None
    if lenses is not None:
        free = lenses.free.reshape(-1)
        before = np.where(free, 1 / np.where(lenses.free, lenses.deviation, 1.0).reshape(-1) ** 2, 0.0)
        information = information.with_diagonal(np.concatenate([np.zeros(6 * n), before]))
    found = covariance(cameras, information, free, (by_tracks | by_patches) & together, bodies)
    known = together & (np.sqrt(np.trace(found[:, :3, :3], axis1=1, axis2=2)) < numbers.most_rotation)
    if not known.all():  # what is not known must not turn the others' frame
        found = covariance(cameras, information, free, known, bodies)
    away = np.full((n, 6), np.nan)
    if known.any():
        frame = bodies and bodies.input_from_optimised(preferred, world_from_cam)
        frame = frame or align_by_spread(preferred[known], world_from_cam[known])
        away = Cameras.of(frame.apply_to_poses(preferred)).apart(Cameras.of(world_from_cam)).reshape(n, 6)
        found = _turn(frame) @ found @ _turn(frame).T
        known &= np.sqrt((away[:, :3] ** 2).sum(1)) < numbers.most_rotation
    away[~known], found[~known] = np.nan, np.nan
    return ExpectedErrors(away, found, by_tracks, by_patches)


def _turn(b_from_a: Similarity) -> Array:
    """The matrix [6, 6] from increments of poses in a to those in b."""
    turn = np.zeros((6, 6))
    turn[:3, :3], turn[3:, 3:] = b_from_a.rotation, b_from_a.scale * b_from_a.rotation
    return turn


def bound_90(moments: Array, away: Array) -> Array:
    """Lengths [n] that one in ten errors exceeds: of normal deviates with mean `away` [n, 3], mean squares [n, 3, 3].

    Their squared length is approximated by a chi square with the degrees of freedom that its mean and variance give
    (Satterthwaite 1946), and that by the cube of a normal deviate (Wilson and Hilferty 1931).
    """
    mean = np.trace(moments, axis1=1, axis2=2)
    # The variance is 2 tr C^2 + 4 d^T C d with C = M - d d^T.
    variance = 2 * (moments**2).sum((1, 2)) - 2 * (away**2).sum(1) ** 2
    with np.errstate(invalid="ignore", divide="ignore"):
        share = np.maximum(variance, 0) / (9 * mean**2)  # 2 / 9 of a degree of freedom's inverse
        return np.asarray(np.sqrt(mean * (1 - share + NORMAL_90 * np.sqrt(share)) ** 3))
