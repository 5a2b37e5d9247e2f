"""The choice of the poses that a run returns: candidates from all evidence, judged by what was left out of it."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray

from biresnerf.arrays import Array
from biresnerf.data.seeding.initial_poses import InitialPoses
from biresnerf.geometry.camera.camera_models import Camera
from biresnerf.geometry.rigid_bodies import RigidBodies
from biresnerf.options.refine_options import ResolvedOptions
from biresnerf.refinement.adjustment.adjustment import NOTHING_FITS, Adjustment, adjust_poses, misfit
from biresnerf.refinement.adjustment.cameras import Cameras
from biresnerf.refinement.adjustment.choice import Candidate, Choice, choose
from biresnerf.refinement.adjustment.evidence import Evidence, PosePrior
from biresnerf.refinement.adjustment.measured_terms import control_believed, measured_misfits
from biresnerf.refinement.adjustment.solver.covariance import NOTHING_KNOWN
from biresnerf.refinement.finish.candidates import (
    BY_TRACKS,
    ORDER,
    adjust,
    as_candidate,
    without_adjustment,
)
from biresnerf.refinement.finish.expected_errors import expected_errors
from biresnerf.refinement.finish.gather_evidence import SplitEvidence
from biresnerf.refinement.finish.given_poses import input_accuracy, loosened
from biresnerf.refinement.finish.lens_evidence import contradicted_focals, focal_certainty, given_focals
from biresnerf.refinement.finish.lens_model import simple_lenses, supported_lenses
from biresnerf.refinement.finish.outcome import Finish, fit_of, heeded, most_heeded
from biresnerf.refinement.parameters.intrinsics_parameters import FocalCertainty
from biresnerf.refinement.parameters.joint_parameters import JointParameters
from biresnerf.refinement.scene.scene import Scene
from biresnerf.report import CandidateName

logger = logging.getLogger(__name__)


# As COLMAP left them: the input's, of photos alone.
OF_MATCHES: tuple[CandidateName, ...] = ("input", "matched")
SAME_POSES = 1e-6


def choose_poses(
    scene: Scene,
    joint: JointParameters,
    gathered: SplitEvidence,
    options: ResolvedOptions,
    announce: Callable[[], None],
) -> tuple[Candidate, Finish, tuple[FocalCertainty | None, ...]] | None:
    """The best candidate, in the unit frame, how it was found, and what is known of each camera's focal length.

    None where no evidence can tell.
    """
    refined = joint.unit_from_cam
    if not np.isfinite(refined).all():
        return None
    cameras = joint.lenses.refined(scene.dataset).cameras
    split, prior, results = _adjusted(gathered, refined, joint, cameras, announce)
    heeding = most_heeded(results)
    if heeding is not None and not _believes_control(heeding, split.fitted):
        logger.info("control points are not believed: too many contradict the photos")
        gathered = replace(gathered, fitted=replace(gathered.fitted, control=None))
        split, prior, results = _adjusted(gathered, refined, joint, cameras, announce)
    noise_px = results["adjusted-tracks"].known_noise_px if "adjusted-tracks" in results else 1.0
    if noise_px > _most_noise_px(split.fitted):
        logger.info("tracks say nothing: their noise is %.1f px", noise_px)
        fitted, left_out = (replace(each, tracks=None) for each in (split.fitted, split.left_out))
        split = replace(split, fitted=fitted, left_out=left_out, tracks=None)
        results = {name: each for name, each in results.items() if name == "adjusted-patches"}
    best = most_heeded(results)
    given = input_accuracy(scene.dataset, best, split.fitted, options)
    looser = None if best is None else loosened(prior, best, split.fitted)
    prior = looser or prior
    if tells := given is not None and given.tells(prior):
        prior = given.prior(prior)
    if tells or looser is not None:
        patched = results.get("adjusted-patches")
        results = adjust(refined, split.fitted, prior, announce, patched.halves if patched else None)
    adjusted = [as_candidate(name, each, split.fitted, cameras) for name, each in results.items()]
    found = [Candidate("refined", refined), *without_adjustment(scene, refined, joint.bodies)]
    candidates = sorted([*found, *filter(None, adjusted)], key=lambda candidate: ORDER.index(candidate.name))
    # Fixed cameras are the same in all candidates: their misfits only show whose points fit them.
    misfits = _misfits(candidates, split, noise_px, ~prior.fixed & split.placed, announce)
    if not misfits:
        return None
    by_tracks = results.get("adjusted-tracks")
    alike = {} if by_tracks is None else {"tracks": _within(candidates, by_tracks, split, joint.bodies)}
    rigs = [(Cameras.of(c.world_from_cam, c.lenses), split.fitted) for c in candidates]
    for kind, (misfit_to, as_well) in measured_misfits(rigs).items():
        misfits[kind], alike[kind] = misfit_to, as_well
    choice = _choice(candidates, misfits, alike, scene.start)
    if choice.chosen.name in OF_MATCHES and by_tracks is not None and "tracks" in misfits:
        misfits["tracks"] = _as_if_left_out(candidates, misfits["tracks"], split, prior, noise_px, cameras)
        choice = _choice(candidates, misfits, alike, scene.start)
    announce()
    chosen, evidence = choice.chosen, dict.fromkeys(results, split.fitted)
    if chosen.name in BY_TRACKS:  # nothing has to be judged any more
        halves = results[chosen.name].halves
        patches = None if halves is None else split.fitted.patches
        heeded_now = evidence[chosen.name] = replace(split.fitted, tracks=split.tracks, patches=patches)
        result = adjust_poses(refined, heeded_now, prior, halves)
        results[chosen.name] = result
        chosen = as_candidate(chosen.name, result, heeded_now, cameras) or chosen
    best = results.get(chosen.name) or next(iter(results.values()), None)
    kept = given_focals(scene.dataset, options.refine_intrinsics, split.fitted.numbers)
    focals = focal_certainty(
        best,
        split.fitted,
        contradicted_focals(refined, split.fitted, split.left_out, prior, noise_px, kept, by_tracks),
    )
    return chosen, Finish(choice.reports, fit_of(candidates, results, evidence), given), focals


def _adjusted(
    split: SplitEvidence,
    refined: Array,
    joint: JointParameters,
    cameras: Sequence[Camera],
    announce: Callable[[], None],
) -> tuple[SplitEvidence, PosePrior, dict[CandidateName, Adjustment]]:
    """The evidence with the lenses that it supports, what is known before, and the poses adjusted to both."""
    loose = np.full(len(refined), split.fitted.numbers.prior)
    loose[split.fitted.held_by_measurements] = NOTHING_KNOWN  # a prior would hold a bend of all cameras
    prior = PosePrior(refined, loose, loose * joint.frame.distance, joint.bodies)
    lenses = supported_lenses(refined, split.fitted, split.left_out, prior, cameras, announce)
    split = replace(split, fitted=replace(split.fitted, lenses=lenses))
    return split, prior, adjust(refined, split.fitted, prior, announce)


def _believes_control(found: Adjustment, evidence: Evidence) -> bool:
    lenses = heeded("adjusted", found, evidence).lenses
    return control_believed(evidence, Cameras.of(found.world_from_cam, lenses))


def _choice(
    candidates: Sequence[Candidate],
    misfits: Mapping[str, Array],
    alike: Mapping[str, NDArray[np.bool_]],
    start: InitialPoses,
) -> Choice:
    """As `choose`; but a tie does not return to the input's poses where photos chose those of matches as the start."""
    choice = choose(candidates, misfits, alike, _kept_on_a_tie(candidates, set(misfits), alike))
    names = [candidate.name for candidate in candidates]
    matches_won = "matched" in names and len(start.trials) > 1 and start.mostly_matched
    if choice.chosen.name == "input" and matches_won:
        return choose(candidates, misfits, alike, names.index("matched"))
    return choice


def _kept_on_a_tie(
    candidates: Sequence[Candidate], kinds: set[str], alike: Mapping[str, NDArray[np.bool_]]
) -> int:
    """The input's poses; the refined ones where no evidence distinguishes the two: the verdict will, by photos."""
    names = [candidate.name for candidate in candidates]
    both = [names.index("input"), names.index("refined")] if "input" in names else [0, 0]
    told_apart = any(kind not in alike or not alike[kind][both].all() for kind in kinds)
    return both[0] if told_apart else both[1]


def _misfits(
    candidates: Sequence[Candidate],
    split: SplitEvidence,
    noise_px: float,
    judging: NDArray[np.bool_],
    announce: Callable[[], None],
) -> dict[str, Array]:
    """Misfits of the judging cameras [candidates, m] to the left-out part of each kind of evidence that can tell."""
    found: dict[str, Array] = {}
    for kind, left_out in (
        ("tracks", replace(split.left_out, patches=None)),
        ("patches", replace(split.left_out, tracks=None)),
    ):
        if left_out.tracks is not None or left_out.patches is not None:
            announce()
            misfits = np.stack([_misfit(each, left_out, noise_px) for each in candidates])[:, judging]
            if _tells(misfits):
                found[kind] = misfits
    return found


def _within(
    candidates: Sequence[Candidate], by_tracks: Adjustment, split: SplitEvidence, bodies: RigidBodies
) -> NDArray[np.bool_]:
    """Candidates [c] that are as near to the poses that tracks prefer as the truth may be.

    Tracks that were left out share some errors with those that were adjusted to (of lenses, of features that lie beside
    the surface), and so prefer poses that were fitted to such errors, even to the true ones.
    """
    evidence = heeded("adjusted-tracks", by_tracks, split.fitted)
    found = (
        expected_errors(each.world_from_cam, by_tracks.world_from_cam, evidence, bodies=bodies)
        for each in candidates
    )
    return np.array([each.deviations < evidence.numbers.told_apart for each in found])


def _misfit(candidate: Candidate, evidence: Evidence, noise_px: float) -> Array:
    """Misfit of a candidate by its own poses and lenses."""
    return misfit(candidate.world_from_cam, replace(evidence, lenses=candidate.lenses), noise_px)


def _as_if_left_out(
    candidates: Sequence[Candidate],
    misfits: Array,
    split: SplitEvidence,
    prior: PosePrior,
    noise_px: float,
    cameras: Sequence[Camera],
) -> Array:
    """Misfits [candidates, m] to tracks, as if poses of matches had not been fitted to the judging tracks.

    COLMAP fitted its model to all tracks, so those left out favour it. It is replaced by its poses and simple lens as
    adjusted to the others alone, where that fits worse.
    """
    matched = next((each for each in candidates if each.name == "matched"), None)
    if matched is None:
        return misfits
    lenses = split.fitted.lenses
    simple = None if lenses is None else simple_lenses(lenses, cameras)
    evidence = replace(split.fitted, patches=None, lenses=simple)
    around = replace(prior, world_from_cam=matched.world_from_cam)
    found = adjust_poses(matched.world_from_cam, evidence, around)
    known = None if found.lenses is None or simple is None else simple.known(found.lenses.correction)
    again = _misfit(
        replace(matched, world_from_cam=found.world_from_cam, lenses=known), split.left_out, noise_px
    )
    judged = again[~prior.fixed & split.placed]
    judging = misfits.copy()
    for row, each in enumerate(candidates):
        alike = np.allclose(each.world_from_cam, matched.world_from_cam, rtol=0, atol=SAME_POSES)
        if each.name in OF_MATCHES and alike and np.nanmedian(judged) > np.nanmedian(misfits[row]):
            judging[row] = judged
    return judging


def _tells(misfits: Array) -> bool:
    """Whether evidence [candidates, n] covers half of the cameras, and fits them at the best candidate."""
    known = np.isfinite(misfits).all(0)
    if not known.any() or known.mean() < 0.5:
        return False
    return bool(np.median(misfits[:, known], axis=1).min() < NOTHING_FITS / 2)


def _most_noise_px(evidence: Evidence) -> float:
    """The most noise that features have; with more, the tracks are wrong."""
    size = torch.maximum(evidence.intrinsics.width, evidence.intrinsics.height).double().median()
    return max(evidence.numbers.most_noise_px, evidence.numbers.most_noise * float(size))
