"""The joint adjustment: all cameras and lenses to tracks and patches, robust, every noise level measured on the set."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from biresnerf.arrays import Array
from biresnerf.data.points.tracks import Tracks
from biresnerf.geometry.pose_error import camera_errors
from biresnerf.geometry.similarity import align_by_spread
from biresnerf.refinement.adjustment.cameras import POSE, Cameras
from biresnerf.refinement.adjustment.evidence import Evidence, PosePrior
from biresnerf.refinement.adjustment.kernels.patches import UNSEEN
from biresnerf.refinement.adjustment.lens.lenses import (
    KINDS,
    LENS,
    Lenses,
    LensEstimate,
)
from biresnerf.refinement.adjustment.measured_terms import measured_terms
from biresnerf.refinement.adjustment.patch_term import PatchTerm
from biresnerf.refinement.adjustment.solver.blocks import Blocks, tied_parts
from biresnerf.refinement.adjustment.solver.covariance import covariance
from biresnerf.refinement.adjustment.solver.elimination import peak_bytes
from biresnerf.refinement.adjustment.solver.lens_deviations import posterior
from biresnerf.refinement.adjustment.solver.solve import Prior, minimise, normal_equations
from biresnerf.refinement.adjustment.solver.term import Term
from biresnerf.refinement.adjustment.track_term import ROBUST_SCALE, TrackTerm
from biresnerf.refinement.numbers.finish import EvidenceNumbers


@dataclass(frozen=True, eq=False)
class Halves:
    """A check of the patches: the results of adjusting to two halves of them separately.

    Attributes:
        middle: cameras between the two results.
        noise: level of the patches' noise.
        inliers: share of comparisons within the robust scale; if it was too small from the start, nothing was adjusted.
        apart_deg: mean rotation between the two results, aligned.
        moved_deg: mean rotation from the start to their mean, aligned.
    """

    middle: Cameras = field(repr=False)
    noise: float
    inliers: float
    numbers: EvidenceNumbers = field(repr=False)
    apart_deg: float = 0.0
    moved_deg: float = 0.0

    @property
    def trusted(self) -> bool:
        """Whether the halves found much the same, from enough comparisons that fit."""
        bound_deg = self.numbers.most_apart * self.moved_deg + self.numbers.still_deg
        return self.apart_deg < bound_deg and self.inliers > self.numbers.least_inliers


# Of the matrix, at once; and bytes of an observation (`benchmarks.large.many_cameras`).
COPIES, OBSERVATION_BYTES = 6, 900
NOTHING_FITS = ROBUST_SCALE**2  # a misfit is below it


@dataclass(frozen=True, eq=False)
class Adjustment:
    """Adjusted cameras, and how well the evidence fits them.

    Attributes:
        world_from_cam: [n, 4, 4].
        track_noise_px, patch_noise: measured; NaN where there is no such evidence.
        track_inliers, patch_inliers: share of residuals within the robust scale; NaN likewise.
        used: whether there was any evidence to adjust to; otherwise the poses are those given.
        halves: of the patches, as found on the way; None where there are none.
        lenses: what was found of them; None where the evidence has none.
    """

    world_from_cam: Array
    track_noise_px: float
    patch_noise: float
    track_inliers: float
    patch_inliers: float
    used: bool
    halves: Halves | None = None
    lenses: LensEstimate | None = None

    @property
    def known_noise_px(self) -> float:
        """The noise of the tracks, to judge other poses by; one where it was not measured."""
        return self.track_noise_px if np.isfinite(self.track_noise_px) else 1.0


def adjust_poses(
    world_from_cam: Array, evidence: Evidence, prior: PosePrior, halves: Halves | None = None
) -> Adjustment:
    """Adjust poses [n, 4, 4] to evidence, starting from them, and its lenses as far as it determines them.

    Never raises on poor evidence: where it fixes nothing, poses and lenses stay. Patches whose halves disagree are
    ignored.

    Args:
        halves: of the same patches from the same poses and lenses, where they are known.
    """
    found, lenses = _adjusted(world_from_cam, evidence, prior, halves), evidence.lenses
    if lenses is None or found.lenses is None:
        return found
    unknown = lenses.free & ~found.lenses.observable
    if not unknown.any():
        return found
    # The parameters are given up one kind at a time: without the last, the evidence may determine the others.
    last = next(kind for kind in reversed(KINDS) if unknown[:, kind].any())
    given_up = unknown & np.isin(np.arange(LENS), last)
    again = adjust_poses(world_from_cam, replace(evidence, lenses=lenses.held(given_up)), prior)
    if again.lenses is None:
        return again
    deviation = np.where(given_up, found.lenses.deviation, again.lenses.deviation)
    return replace(again, lenses=replace(again.lenses, deviation=deviation))


def adjustment_bytes(tracks: Tracks, cameras: int, enough: int | None = None) -> int:
    """Memory that adjusting so many cameras to tracks takes at most, by which of them see the same points.

    Args:
        enough: what takes more than this is not looked at closely.
    """
    start = np.searchsorted(tracks.point, np.arange(tracks.points + 1)).astype(np.int64)
    block = COPIES * 8 * POSE**2
    most = None if enough is None else enough // block
    begin, other = tied_parts(cameras, start, tracks.image.astype(np.int64)[:, None], most)
    needed = block * int(begin[-1]) + OBSERVATION_BYTES * len(tracks.point)
    return needed + (peak_bytes(begin, other) if len(other) else 0)


def _adjusted(
    world_from_cam: Array, evidence: Evidence, prior: PosePrior, halves: Halves | None
) -> Adjustment:
    """Adjust with all lens parameters free that may move, whether or not the evidence determines them."""
    lenses = evidence.lenses
    cameras, before = Cameras.of(world_from_cam, lenses), Prior.of(prior, lenses)
    if halves is None and evidence.patches is not None and len(evidence.patches) > 1:
        halves = _halves(cameras, evidence, before)
    start, patch_noise = (cameras, 1.0) if halves is None else (halves.middle, halves.noise)
    if halves is not None and not halves.trusted:
        start, evidence = cameras, replace(evidence, patches=None)
    tracks, patches = track_term(start, evidence, None), patch_term(start, evidence, patch_noise)
    terms: list[Term] = [term for term in (tracks, patches) if term is not None]
    if terms:
        terms += measured_terms(evidence, start).values()
    found = minimise(start, terms, before) if terms else cameras
    if not all(np.isfinite(part).all() for part in (found.rotation, found.centre, found.lens)):
        found, terms = cameras, []
    return Adjustment(
        world_from_cam=found.world_from_cam() if terms else np.array(world_from_cam, dtype=np.float64),
        track_noise_px=tracks.noise_px if tracks else np.nan,
        patch_noise=patch_noise if patches else np.nan,
        track_inliers=float(tracks.inliers(found).mean()) if tracks else np.nan,
        patch_inliers=float(patches.inliers(found).mean()) if patches else np.nan,
        used=bool(terms),
        halves=halves,
        lenses=_lens_estimate(found, terms, lenses, evidence.numbers) if lenses is not None else None,
    )


def _halves(cameras: Cameras, evidence: Evidence, prior: Prior) -> Halves:
    """Adjust to two halves of the patches, each on its own, if enough of them fit the coarsest scale from the start.

    The noise level is chosen so that the covariance of their difference matches the difference.
    """
    assert evidence.patches is not None
    numbers, even = evidence.numbers, np.arange(len(evidence.patches)) % 2 == 0
    parts = (evidence.patches.of(half) for half in (even, ~even))
    terms = [PatchTerm(part, evidence.intrinsics, cameras, numbers) for part in parts]
    fitting = float(np.mean([term.inliers(cameras).mean() for term in terms]))
    if not fitting > numbers.least_inliers:  # the field shows no surface that photos agree on
        return Halves(cameras, 1.0, fitting, numbers)
    ends, expected, inliers = [], 0.0, []
    for term in terms:
        end = minimise(cameras, [term], prior)
        ends.append(end)
        inliers.append(float(term.inliers(end).mean()))
        information, _ = normal_equations(end, [term.linearise(end, 0.0)], prior)
        free = prior.free[POSE * len(end) :]
        turned = covariance(end, information, free, bodies=prior.bodies)[:, :3, :3]
        expected += float(np.trace(turned, axis1=1, axis2=2).mean())
    middle = ends[1].moved(ends[0].apart(ends[1]) / 2)
    apart = _rotations_deg(ends[0], ends[1])
    moved_deg = float(_rotations_deg(middle, cameras).mean())
    noise = float(np.sqrt(np.mean(np.radians(apart) ** 2) / max(expected, 1e-300)))
    noise = max(1.0, noise) if np.isfinite(noise) else 1.0
    return Halves(middle, noise, float(np.mean(inliers)), numbers, float(apart.mean()), moved_deg)


def _rotations_deg(one: Cameras, other: Cameras) -> Array:
    a, b = one.world_from_cam(), other.world_from_cam()
    return camera_errors(align_by_spread(a, b).apply_to_poses(a), b).rotation_deg


def _lens_estimate(
    cameras: Cameras, terms: list[Term], lenses: Lenses, numbers: EvidenceNumbers
) -> LensEstimate:
    information = sum((term.linearise(cameras, 0.0).system for term in terms), Blocks.nothing(cameras))
    deviation = posterior(cameras, information, lenses)
    with np.errstate(invalid="ignore"):
        observable = lenses.free & (deviation < numbers.observable * lenses.deviation)
    return LensEstimate(cameras.lens, deviation, observable)


def misfit(world_from_cam: Array, evidence: Evidence, noise_px: float) -> Array:
    """How badly poses fit evidence that they were not adjusted to: each camera's mean robust square [n].

    Points are estimated anew for these poses, as are the depths of patches: poses must be in their frame. A residual e,
    in noise levels, counts S^2 e^2 / (S^2 + e^2), below `NOTHING_FITS`. NaN for a camera without evidence.

    Args:
        noise_px: standard deviation of either coordinate of an observation at poses without error, as measured by an
            adjustment; must be the same for all poses that are compared.
    """
    cameras = Cameras.of(world_from_cam, evidence.lenses)
    n = len(cameras)
    total, count = np.zeros(n), np.zeros(n)
    tracks = track_term(cameras, evidence, noise_px)
    if tracks is not None:
        tracks.settle(cameras)
        robust = _robust((tracks.errors_px(cameras) / noise_px) ** 2, ROBUST_SCALE)
        total += np.bincount(tracks.image, robust, n)
        count += np.bincount(tracks.image, minlength=n)
    patches = patch_term(cameras, evidence, 1.0)
    if patches is not None:
        patches.settle(cameras)
        square = patches.squares(cameras, patches.unknowns)
        robust = _robust(square, patches.scale) * (ROBUST_SCALE / patches.scale) ** 2
        for image in (patches.patches.target, patches.patches.host[patches.patches.point]):
            total += np.bincount(image, robust, n)
            count += np.bincount(image, minlength=n)
    with np.errstate(invalid="ignore"):
        return np.where(count > 0, total / np.maximum(count, 1), np.nan)


def _robust(square: Array, scale: float) -> Array:
    """Geman and McClure's cost; at most the square of the scale."""
    return np.asarray(1 / (1 / scale**2 + 1 / np.clip(square, 1e-300, UNSEEN)))


def track_term(cameras: Cameras, evidence: Evidence, noise_px: float | None) -> TrackTerm | None:
    """The term of the tracks; None where there are none, or fewer residuals than unknowns."""
    tracks = evidence.tracks
    if tracks is None or len(tracks.point) == 0:
        return None
    points = int(tracks.point[-1]) + 1
    if noise_px is None and 2 * len(tracks.point) <= 3 * points + 6 * len(np.unique(tracks.image)) - 7:
        return None
    return TrackTerm(tracks, evidence.intrinsics, cameras, noise_px)


def patch_term(cameras: Cameras, evidence: Evidence, noise: float) -> PatchTerm | None:
    """The finest term of the patches; None where there are none."""
    if evidence.patches is None or len(evidence.patches.target) == 0:
        return None
    return PatchTerm(evidence.patches, evidence.intrinsics, cameras, evidence.numbers, noise, last_only=True)
