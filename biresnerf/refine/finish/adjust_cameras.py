"""All cameras adjusted at once: candidates from all evidence, judged by what none was fitted to, the best one taken."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import torch
from numpy.typing import NDArray

from biresnerf.geometry.camera.camera_models import Camera
from biresnerf.geometry.rigid_bodies import RigidBodies
from biresnerf.geometry.similarity import align_robust
from biresnerf.refine.adjustment.adjustment import NOTHING_FITS, Adjustment, Halves, adjust_poses, misfit
from biresnerf.refine.adjustment.choice import Candidate, Choice, choose
from biresnerf.refine.adjustment.evidence import Evidence, NoiseLevels, PosePrior
from biresnerf.refine.finish.gather_evidence import gather_evidence
from biresnerf.refine.finish.given_poses import GivenPoses, input_accuracy
from biresnerf.refine.finish.lens_evidence import (
    contradicted_focals,
    corrected_cameras,
    focal_certainty,
    given_focals,
)
from biresnerf.refine.finish.photo_trial import photos_object
from biresnerf.refine.optimise.joint_optimiser import JointOptimiser
from biresnerf.refine.scene.scene import Scene
from biresnerf.refine.stages.two_stages import TwoStages
from biresnerf.refine.start.first_step import adjusts_cameras
from biresnerf.report import CandidateName, CandidateReport

logger = logging.getLogger(__name__)

Array = NDArray[np.float64]

# On a tie the earlier is kept: the input's poses, unless the evidence cannot tell.
ORDER: tuple[CandidateName, ...] = (
    "input", "refined", "adjusted", "adjusted-patches", "adjusted-tracks", "matched",
)  # fmt: skip
# Candidates that patches were to be trusted for, and that patches left out prefer: photos have spoken for them.
BY_PATCHES: tuple[CandidateName, ...] = ("adjusted", "adjusted-patches")
# Standard deviations of the refined poses' errors, rad and distances of the cameras from the scene: far more than they
# have, so that only what no evidence fixes is left to them.
PRIOR = 0.02
# Of tracks, in px or in shares of the photos' size. Sets have 0.1 to 0.5 px.
MOST_NOISE_PX, MOST_NOISE = 2.0, 0.002


@dataclass(frozen=True, eq=False)
class Fit:
    """Poses [n, 4, 4] in the unit frame that were adjusted to evidence, and the level of its patches' noise."""

    world_from_cam: Array
    evidence: Evidence
    patch_noise: float


@dataclass(frozen=True, eq=False)
class Finish:
    """What came of the last step.

    Attributes:
        candidates: the poses that were compared, and how they did.
        fit: of the poses to all evidence that is to be trusted; None where there is none.
        given: how accurate the input's poses are; None where that is not known.
    """

    candidates: tuple[CandidateReport, ...] = ()
    fit: Fit | None = None
    given: GivenPoses | None = None

    @property
    def kept(self) -> bool:
        """Whether nothing was better than the poses as they were."""
        return any(each.chosen and each.name == "refined" for each in self.candidates)

    @property
    def heeds_photos(self) -> bool:
        """Whether patches of the photos were to be trusted."""
        return self.fit is not None and self.fit.evidence.patches is not None

    def refused(self) -> Finish:
        """The same where the chosen poses are not taken, and the evidence that prefers them is not believed."""
        kept = (each.model_copy(update={"chosen": each.name == "refined"}) for each in self.candidates)
        return Finish(tuple(kept))


def adjust_cameras(stages: TwoStages) -> Finish:
    """Adjust all cameras at once, and where left-out evidence says that is better move them and hold them there.

    Cameras that their own matches contradict are placed by those first. Photos have the last word: nothing is moved
    where they object, by fields that are trained on them unless patches of them speak for it. Methods of others are
    left alone.

    Raises:
        Interrupted: stopped; a continued run adjusts again.
    """
    optimiser = stages.optimiser
    if not adjusts_cameras(stages.scene.dataset, optimiser.method):
        return Finish()
    certainty = optimiser.lenses.certainty
    with stages.timed("adjusting"):
        stages.repair.place_by_matches()
        found = _choice(stages.scene, optimiser, partial(_announce, stages))
    if found is None:
        return Finish()
    choice, finish = found
    cameras = optimiser.lenses.refined(stages.scene.dataset).cameras
    chosen, lenses = choice.chosen, choice.chosen.lenses
    if lenses is not None:
        cameras = corrected_cameras(cameras, lenses.correction) or cameras
    asked = chosen.name not in ("refined", *BY_PATCHES)
    if asked and photos_object(stages, chosen.world_from_cam, cameras):
        logger.info("the photos contradict these poses, which are not taken")
        optimiser.lenses.certainty = certainty
        return finish.refused()
    if chosen.name != "refined":
        stages.place(chosen.world_from_cam)
        optimiser.poses_held = True
    if lenses is not None:
        optimiser.lenses.place(stages.scene.dataset.cameras, cameras)
    return finish


def _choice(
    scene: Scene, optimiser: JointOptimiser, announce: Callable[[], None]
) -> tuple[Choice, Finish] | None:
    """None where no evidence can tell. Candidates are in the unit frame."""
    split = gather_evidence(scene, optimiser)
    refined = optimiser.poses.poses().numpy()
    if not np.isfinite(refined).all():
        return None
    prior = PosePrior.equal(refined, PRIOR, PRIOR * optimiser.frame.distance, optimiser.bodies)
    results = _adjusted(refined, split.fitted, prior, announce)
    noise = results["adjusted-tracks"].noise if "adjusted-tracks" in results else NoiseLevels()
    if noise.track_px > _most_noise_px(split.fitted):
        logger.info("tracks say nothing: their noise is %.1f px", noise.track_px)
        split = replace(
            split, fitted=replace(split.fitted, tracks=None), left_out=replace(split.left_out, tracks=None)
        )
        results = {name: each for name, each in results.items() if name == "adjusted-patches"}
    given = input_accuracy(scene.dataset, _most_heeded(results), split.fitted, optimiser.options)
    if given is not None and given.tells(prior):
        prior = given.prior(prior)
        patched = results.get("adjusted-patches")
        results = _adjusted(refined, split.fitted, prior, announce, patched.halves if patched else None)
    cameras = optimiser.lenses.refined(scene.dataset).cameras
    adjusted = [_candidate(name, each, split.fitted, cameras) for name, each in results.items()]
    found = [
        Candidate("refined", refined),
        *_earlier(scene, refined, optimiser.bodies),
        *filter(None, adjusted),
    ]
    candidates = sorted(found, key=lambda candidate: ORDER.index(candidate.name))
    # Fixed cameras are the same in all candidates: theirs tell only whose points fit them.
    judging = ~prior.fixed & split.placed
    misfits: dict[str, Array] = {}
    for kind, left_out in (
        ("tracks", replace(split.left_out, patches=None)),
        ("patches", replace(split.left_out, tracks=None)),
    ):
        if left_out.tracks is not None or left_out.patches is not None:
            announce()
            misfits[kind] = np.stack([_misfit(each, left_out, noise) for each in candidates])[:, judging]
    if not any(map(_tells, misfits.values())):
        return None
    choice = choose(candidates, misfits)
    announce()
    best = results.get(choice.chosen.name) or next(iter(results.values()), None)
    kept = given_focals(scene.dataset, optimiser.options.refine_intrinsics)
    optimiser.lenses.certainty = focal_certainty(
        best, split.fitted, contradicted_focals(refined, split.fitted, split.left_out, prior, noise, kept)
    )
    return choice, Finish(choice.reports, _fit(candidates, results, split.fitted), given)


def _most_heeded(results: Mapping[CandidateName, Adjustment]) -> Adjustment | None:
    """The adjustment to most kinds of evidence that is to be believed."""
    return next((results[name] for name in ORDER if name in results and _usable(results[name])), None)


def _fit(
    candidates: Sequence[Candidate], results: Mapping[CandidateName, Adjustment], evidence: Evidence
) -> Fit | None:
    """The adjusted poses that heed most; None where none was to be believed."""
    name = next((each.name for each in candidates if each.name in results), None)
    if name is None:
        return None
    found, lenses = results[name], evidence.lenses
    if lenses is not None and found.lenses is not None:
        lenses = replace(lenses, correction=found.lenses.correction)
    heeded = Evidence(
        evidence.intrinsics,
        evidence.tracks if name != "adjusted-patches" else None,
        evidence.patches if name != "adjusted-tracks" else None,
        lenses,
    )
    return Fit(found.world_from_cam, heeded, found.patch_noise if heeded.patches else 1.0)


def _misfit(candidate: Candidate, evidence: Evidence, noise: NoiseLevels) -> Array:
    """Of its own poses and lenses."""
    return misfit(candidate.world_from_cam, replace(evidence, lenses=candidate.lenses), noise)


def _tells(misfits: Array) -> bool:
    """Whether evidence [candidates, n] knows half of the cameras, and fits them with the best candidate."""
    known = np.isfinite(misfits).all(0)
    if not known.any() or known.mean() < 0.5:
        return False
    return bool(np.median(misfits[:, known], axis=1).min() < NOTHING_FITS / 2)


def _adjusted(
    refined: Array,
    evidence: Evidence,
    prior: PosePrior,
    announce: Callable[[], None],
    halves: Halves | None = None,
) -> dict[CandidateName, Adjustment]:
    """Adjusted to tracks, to patches and to both; ``halves`` of the patches where they are known."""
    found: dict[CandidateName, Adjustment] = {}

    def add(name: CandidateName, evidence: Evidence, halves: Halves | None = None) -> Adjustment:
        announce()
        found[name] = result = adjust_poses(refined, evidence, prior, halves)
        logger.info("%s: %s", name, _described(result))
        return result

    if evidence.tracks:
        add("adjusted-tracks", replace(evidence, patches=None))
    if evidence.patches:
        patched = add("adjusted-patches", replace(evidence, tracks=None), halves)
        if evidence.tracks and _usable(patched):
            add("adjusted", evidence, patched.halves)
    return found


def _candidate(
    name: CandidateName, found: Adjustment, evidence: Evidence, cameras: Sequence[Camera]
) -> Candidate | None:
    """An adjustment as a candidate; None where it is not to be believed, or a corrected camera would be no lens."""
    if not _usable(found):
        return None
    if found.lenses is None or evidence.lenses is None or not found.lenses.correction.any():
        return Candidate(name, found.world_from_cam)
    if corrected_cameras(cameras, found.lenses.correction) is None:
        return None
    return Candidate(name, found.world_from_cam, evidence.lenses.known(found.lenses.correction))


def _most_noise_px(evidence: Evidence) -> float:
    """More is no feature's noise: the tracks are wrong."""
    size = torch.maximum(evidence.intrinsics.width, evidence.intrinsics.height).double().median()
    return max(MOST_NOISE_PX, MOST_NOISE * float(size))


def _usable(found: Adjustment) -> bool:
    return found.used and (found.agreement is None or found.agreement.trusted)


def _described(found: Adjustment) -> str:
    return (
        f"tracks {found.track_noise_px:.2f} px, {found.track_inliers:.2f} of them within, "
        f"patches {found.patch_inliers:.2f}, {found.agreement}"
    )


def _earlier(scene: Scene, refined: Array, bodies: RigidBodies) -> list[Candidate]:
    """The input's poses, and those of matches where there are any, carried to the refined ones' frame and bodies."""
    given: list[tuple[CandidateName, Array | None]] = [
        ("input", scene.dataset.world_from_cam),
        ("matched", scene.start.matched_poses),
    ]
    return [
        Candidate(
            name,
            bodies.held(align_robust(poses, refined, with_rotations=True).apply_to_poses(poses), refined),
        )
        for name, poses in given
        if poses is not None and np.isfinite(poses).all()
    ]


def _announce(stages: TwoStages) -> None:
    stages.monitor.raise_if_stopped("stopped while the cameras were adjusted; run again to go on")
    stages.announce("adjusting all cameras at once")
