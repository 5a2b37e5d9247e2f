"""Which parameters of unknown lenses the evidence supports: from a simple model to the largest that pays."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from biresnerf.arrays import Array
from biresnerf.geometry.camera.camera_models import REFINED_PARAMETERS, Camera
from biresnerf.judging.compare import FREER_LENS, is_better
from biresnerf.refinement.adjustment.adjustment import Adjustment, adjust_poses, track_term
from biresnerf.refinement.adjustment.cameras import Cameras
from biresnerf.refinement.adjustment.evidence import Evidence, PosePrior
from biresnerf.refinement.adjustment.lens.lenses import FOCAL, K1, KINDS, LENS, Lenses
from biresnerf.refinement.adjustment.solver.lens_deviations import posterior
from biresnerf.refinement.adjustment.solver.solve import Prior, newton_step
from biresnerf.refinement.adjustment.track_term import ROBUST_SCALE

logger = logging.getLogger(__name__)


def supported_lenses(
    world_from_cam: Array,
    fitted: Evidence,
    left_out: Evidence,
    prior: PosePrior,
    cameras: Sequence[Camera],
    announce: Callable[[], None],
) -> Lenses | None:
    """The lenses of the evidence with everything held that tracks do not support.

    All start with a focal length and the first radial coefficient, where their cameras' models have it. Then the
    principal point is freed, the radial coefficients, tangential ones and the ratio of focal lengths, one after
    the other. Each stays free where tracks determine its value and show that it differs from the simpler lens's, and
    where left-out tracks fit better.
    """
    lenses = fitted.lenses
    if lenses is None:
        return None
    kept = simple_lenses(lenses, cameras)
    if (kept.free == lenses.free).all():
        return lenses
    if fitted.tracks is None or left_out.tracks is None:
        return kept
    tracks = fitted.tracks.thinned(fitted.numbers.lens_observations, len(world_from_cam))
    fitted, left_out = replace(fitted, tracks=tracks, patches=None), replace(left_out, patches=None)
    best = adjust_poses(world_from_cam, replace(fitted, lenses=kept), prior)
    for kind in KINDS:
        tried = lenses.held(~kept.free & ~_of(kind))
        told = _told(best, replace(fitted, lenses=tried), prior, kept)
        if not told.any():
            continue
        announce()
        tried = lenses.held(~kept.free & ~(told[:, None] & _of(kind)))
        found = adjust_poses(world_from_cam, replace(fitted, lenses=tried), prior)
        if found.lenses is not None and _pays(found, best, replace(left_out, lenses=tried)):
            logger.info("lenses: parameters %s are free in %d of them", kind, told.sum())
            kept, best = tried, found
    return kept


def simple_lenses(lenses: Lenses, cameras: Sequence[Camera]) -> Lenses:
    """The lenses with no more free than a focal length, and the first radial coefficient where models have it."""
    simple = np.zeros_like(lenses.free)
    simple[:, FOCAL], simple[:, K1] = True, ["k1" in REFINED_PARAMETERS[camera.model] for camera in cameras]
    return lenses.held(~simple)


def _told(best: Adjustment, fitted: Evidence, prior: PosePrior, kept: Lenses) -> NDArray[np.bool_]:
    """Lenses [g] with a parameter free beyond `kept` that tracks determine, and one step moves far beyond its error."""
    lenses = fitted.lenses
    assert lenses is not None
    if not best.used or best.lenses is None:
        return np.zeros(len(lenses.free), np.bool_)
    now = replace(lenses, correction=best.lenses.correction)
    cameras = Cameras.of(best.world_from_cam, now)
    term = track_term(cameras, fitted, best.track_noise_px)
    if term is None:
        return np.zeros(len(lenses.free), np.bool_)
    term.settle(cameras)
    linear = term.linearise(cameras, 0.0)
    step = newton_step(cameras, [linear], Prior.of(prior, lenses))
    if step is None:
        return np.zeros(len(lenses.free), np.bool_)
    moved = np.abs(cameras.split(step)[1])
    deviation = posterior(cameras, linear.system, lenses)
    with np.errstate(invalid="ignore"):
        known = lenses.free & ~kept.free & (deviation < fitted.numbers.observable * lenses.deviation)
        return np.asarray((known & (moved > fitted.numbers.track_model_error * deviation)).any(1))


def _pays(found: Adjustment, best: Adjustment, left_out: Evidence) -> bool:
    """Whether points that were left out fit better, beyond chance."""
    ours, theirs = (_misfits(each, left_out, found.track_noise_px) for each in (found, best))
    return ours is not None and theirs is not None and is_better(theirs - ours, FREER_LENS)


def _misfits(found: Adjustment, left_out: Evidence, noise_px: float) -> Array | None:
    """For each point, the robust squares of its observations in noise levels; None where there are too few points."""
    assert found.lenses is not None
    assert left_out.lenses is not None
    cameras = Cameras.of(found.world_from_cam, left_out.lenses.known(found.lenses.correction))
    term = track_term(cameras, left_out, noise_px)
    if term is None or len(term.unknowns) < 2:
        return None
    term.settle(cameras)
    square = np.minimum((term.errors_px(cameras) / noise_px) ** 2, 1e9)
    return np.asarray(
        np.bincount(term.point, ROBUST_SCALE**2 * square / (ROBUST_SCALE**2 + square)), np.float64
    )


def _of(kind: tuple[int, ...]) -> NDArray[np.bool_]:
    """Which parameters [8] are of a kind."""
    return np.isin(np.arange(LENS), kind)
