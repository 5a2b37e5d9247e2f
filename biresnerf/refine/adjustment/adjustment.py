"""The joint adjustment: all cameras at once to tracks and patches, robust, every noise level measured on the set."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from biresnerf.refine.adjustment.cameras import Cameras
from biresnerf.refine.adjustment.covariance import covariance
from biresnerf.refine.adjustment.evidence import Evidence, NoiseLevels, PosePrior
from biresnerf.refine.adjustment.solve import Prior, minimise, normal_equations
from biresnerf.refine.adjustment.term import Term
from biresnerf.refine.adjustment.track_term import ROBUST_SCALE, TrackTerm

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Adjustment:
    """Adjusted cameras, and how well the evidence fits them.

    Attributes:
        world_from_cam: [n, 4, 4].
        covariance: [n, 6, 6] of rotation vector (rad) and position (the poses' unit) in the world's axes, as the
            measured noise explains it, the motion of the whole rig left out.
        track_noise_px, patch_noise: measured; NaN where there is no such evidence.
        track_inliers, patch_inliers: share of residuals within the robust scale; NaN likewise.
        used: whether there was any evidence to adjust to; otherwise the poses are those of the prior.
    """

    world_from_cam: Array
    covariance: Array
    track_noise_px: float
    patch_noise: float
    track_inliers: float
    patch_inliers: float
    used: bool

    @property
    def noise(self) -> NoiseLevels:
        """The measured noise levels, to judge other poses by."""
        one = NoiseLevels()
        return NoiseLevels(
            self.track_noise_px if np.isfinite(self.track_noise_px) else one.track_px,
            self.patch_noise if np.isfinite(self.patch_noise) else one.patch,
        )


def adjust_poses(world_from_cam: Array, evidence: Evidence, prior: PosePrior) -> Adjustment:
    """Adjust poses [n, 4, 4] to evidence, from where they are.

    Never raises on poor evidence: where it fixes nothing, poses stay.
    """
    cameras, before = Cameras.of(world_from_cam), Prior.of(prior)
    tracks = _track_term(cameras, evidence, None)
    terms: list[Term] = [] if tracks is None else [tracks]
    found = minimise(cameras, terms, before) if terms else cameras
    if not (np.isfinite(found.rotation).all() and np.isfinite(found.centre).all()):
        found, terms = cameras, []
    linear = [term.linearise(found, 0.0) for term in terms]
    information, _ = normal_equations(found, linear, before)
    return Adjustment(
        world_from_cam=found.world_from_cam() if terms else np.array(world_from_cam, dtype=np.float64),
        covariance=covariance(found, information, before.free),
        track_noise_px=tracks.noise_px if tracks else np.nan,
        patch_noise=np.nan,
        track_inliers=float(tracks.inliers(found).mean()) if tracks else np.nan,
        patch_inliers=np.nan,
        used=bool(terms),
    )


def misfit(world_from_cam: Array, evidence: Evidence, noise: NoiseLevels) -> Array:
    """How badly poses fit evidence that they were not adjusted to: each camera's mean robust square [n].

    Points are estimated anew for these poses. A residual e, in noise levels, counts S^2 e^2 / (S^2 + e^2), below S^2.
    NaN for a camera that no evidence is of.

    Args:
        noise: as measured by an adjustment; must be the same for all poses that are compared.
    """
    cameras = Cameras.of(world_from_cam)
    n = len(cameras)
    total, count = np.zeros(n), np.zeros(n)
    tracks = _track_term(cameras, evidence, noise.track_px)
    if tracks is not None:
        tracks.settle(cameras)
        square = (tracks.errors_px(cameras) / noise.track_px) ** 2
        robust = 1 / (1 / ROBUST_SCALE**2 + 1 / np.maximum(square, 1e-300))
        total += np.bincount(tracks.image, robust, n)
        count += np.bincount(tracks.image, minlength=n)
    with np.errstate(invalid="ignore"):
        return np.where(count > 0, total / np.maximum(count, 1), np.nan)


def _track_term(cameras: Cameras, evidence: Evidence, noise_px: float | None) -> TrackTerm | None:
    """The term of the tracks; None where there are none, or fewer residuals than unknowns."""
    tracks = evidence.tracks
    if tracks is None or len(tracks.point) == 0:
        return None
    points = int(tracks.point[-1]) + 1
    if noise_px is None and 2 * len(tracks.point) <= 3 * points + 6 * len(np.unique(tracks.image)) - 7:
        return None
    return TrackTerm(tracks, evidence.intrinsics, cameras, noise_px)
