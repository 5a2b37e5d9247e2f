"""The verdict on a finished optimisation: gather the evidence, decide, and check each photo."""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace
from functools import partial
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from biresnerf.arrays import Array
from biresnerf.data.model.dataset import GUESSES, Dataset
from biresnerf.data.workload import JUDGING
from biresnerf.geometry.focus import focus_point, rms_spread
from biresnerf.geometry.pose_error import camera_errors
from biresnerf.refinement.adjustment.cameras import Cameras
from biresnerf.refinement.adjustment.measured_terms import control_believed, measured_misfits
from biresnerf.refinement.finish.expected_errors import ExpectedErrors
from biresnerf.refinement.finish.gather_evidence import measured_evidence
from biresnerf.refinement.finish.outcome import Finish
from biresnerf.refinement.lost.own_matches import contradicted
from biresnerf.refinement.numbers.finish import EvidenceNumbers
from biresnerf.refinement.optimise.methods import Method, Recipe
from biresnerf.refinement.optimise.photo_sampler import PhotoSampler
from biresnerf.refinement.optimise.renderer import Renderer
from biresnerf.refinement.scene.scene import Scene
from biresnerf.refinement.stages.run_state import RunState
from biresnerf.refinement.start.refined_poses import RefinedPoses
from biresnerf.refinement.verdict import image_flags
from biresnerf.refinement.verdict.pose_evidence import compare_on_matches, errors_px, working_share
from biresnerf.refinement.verdict.verdict import (
    Findings,
    decide,
    failed_checks,
    frame_doubt,
    matches_are_better,
)
from biresnerf.refinement.views.compare_rigs import (
    BeforeAfter,
    Effort,
    HeldOutComparison,
    Rig,
    compare_on_unseen_views,
    may_be_blur,
    moved_px,
)
from biresnerf.report import EpipolarEvidence, Finding, Verdict

logger = logging.getLogger(__name__)


GUESSED = GUESSES | {"forward-facing", "turntable"}


@dataclass(frozen=True, eq=False)
class Judgement:
    """The verdict, and what was found about each image [n].

    Attributes:
        trial_psnr: of the unseen views, before and after [2, n]; NaN for the others.
        epipolar_px: before and after [2, n]; NaN where there are too few matches.
        renders: of some held-out views, in the verdict's training on the input's poses and on the refined ones.
        sharpness, gain: see `image_flags`.
        contradicted, contradicted_before, moved_far, blurred, exposure_off: bool.
        errors: expected errors of the refined poses; None where the evidence gives none, or they were not needed.
    """

    verdict: Verdict
    trial_psnr: Array
    renders: BeforeAfter
    epipolar_px: Array
    sharpness: Array
    gain: Array
    contradicted: NDArray[np.bool_]
    contradicted_before: NDArray[np.bool_]
    moved_far: NDArray[np.bool_]
    blurred: NDArray[np.bool_]
    exposure_off: NDArray[np.bool_]
    errors: ExpectedErrors | None = None


def _rounds(run: RunState, times: int, most: int) -> int:
    """How many rounds of trainings of `times` the usual length there is time for."""
    each_s = times * run.monitor.forecast.seconds("judging")
    return int(min(max(run.left_s / max(each_s, 1e-9), 0), most))


def judge_poses(
    scene: Scene,
    renderer: Renderer,
    sampler: PhotoSampler,
    recipe: Recipe,
    lost: int,
    run: RunState,
    finish: Finish,
) -> Judgement:
    """The verdict on the optimised poses, compared with the dataset's own.

    Fields are trained in as many rounds as there is time for, and in one of the usual length in any case.

    Args:
        lost: how many cameras have no fitting pose.
        finish: with the poses that fit all evidence that is to be trusted.

    Raises:
        Interrupted: stopped; a continued run judges again.
    """
    report = partial(run.report_evaluation, message="comparing the refined poses with the input's")
    report(0.0)
    joint, method = renderer.joint, recipe.method
    numbers, most = method.verdict, method.views.rounds_most
    refined = RefinedPoses.now(scene.dataset, joint)
    found = compare_without_training(scene, refined, lost, method)
    # What the evidence determines matters only then; it takes the inverse of a matrix of all cameras.
    asked = matches_are_better(found.findings) and method.uncertainty
    errors = None
    if asked:
        input_from_unit = refined.input_from_unit(joint.frame)
        errors = finish.errors_of(refined.world_from_cam, input_from_unit, joint.bodies)
    told = replace(found.findings, determined=_determined(errors, finish))
    heldout: HeldOutComparison | None = None
    work = 0.0
    if told.moved_px >= numbers.measurable_px:
        effort = Effort(pictured=True, favoured=told.by_matches, moved_px=told.moved_px)
        rounds = max(_rounds(run, 1, most), 1)
        for each in (effort, replace(effort, times=numbers.longer, looks=(1.0,))):
            heldout = compare_on_unseen_views(
                (found.before, found.after), scene.images, scene.held_out, found.placed | (not told.grounded),
                recipe, run.monitor.should_stop, report, replace(each, rounds_most=rounds),
            )  # fmt: skip
            work += heldout.work if heldout else 0.0
            blur = each is effort and heldout is not None and may_be_blur(heldout.evidence, effort, numbers)
            rounds = _rounds(run, numbers.longer, most) if blur else 0
            if not rounds:
                told = replace(told, may_be_blur=blur)
                break
    run.monitor.forecast.took(JUDGING + work)
    verdict = decide(replace(told, heldout=heldout.evidence if heldout else None))
    logger.info("verdict: %s", verdict.verdict)
    gain = image_flags.gains(renderer, sampler)
    return replace(_with_images(verdict, scene, gain, found, heldout, method), errors=errors)


def _determined(errors: ExpectedErrors | None, finish: Finish) -> float | None:
    """The share of cameras that the evidence determines; none where photos, or its noise, contradicted all of it."""
    if finish.fit is None and finish.candidates:
        return 0.0
    return None if errors is None else float(errors.known.mean())


@dataclass(frozen=True, eq=False)
class Compared:
    """The input's poses and refined ones, compared by all but unseen views.

    Attributes:
        before, after: in the input's frame.
        placed: images [n] that had more than a guess for a pose before.
        turned, shifted: how far each camera moved [n], degrees and units.
    """

    before: Rig
    after: Rig
    placed: NDArray[np.bool_]
    turned: Array
    shifted: Array
    findings: Findings


def compare_without_training(scene: Scene, refined: RefinedPoses, lost: int, method: Method) -> Compared:
    """Compare the input's poses and refined ones by motion and feature matches; `lost` cameras have no fitting pose."""
    dataset, images, numbers = scene.dataset, scene.images, method.verdict
    rows = range(len(dataset))
    before = Rig(dataset.world_from_cam, tuple(dataset.camera_of(i) for i in rows))
    after = Rig(refined.world_from_cam, tuple(refined.dataset.camera_of(i) for i in rows))
    apart = camera_errors(after.world_from_cam, before.world_from_cam)
    turned, shifted = apart.rotation_deg, apart.centre
    spread = rms_spread(before.world_from_cam[:, :3, 3])
    grounded = sum(frame.pose_source not in GUESSED for frame in dataset.frames) > len(dataset) / 2
    failed = failed_checks(after.world_from_cam, lost, numbers)
    epipolar: EpipolarEvidence | None = None
    moved = 0.0
    placed = np.array([frame.pose_source not in GUESSES for frame in dataset.frames])
    if np.isfinite(after.world_from_cam).all():
        moved = moved_px(before, after, images)
        if scene.tracks is not None:
            epipolar = compare_on_matches(
                before,
                after,
                scene.tracks,
                placed,
                numbers.least_matched,
                started_from_matches=bool(scene.start.matched.any()),
            )
    findings = Findings(
        failed=failed,
        moved_px=moved,
        heldout=None,
        epipolar=epipolar,
        compared_with=_source_of_poses(dataset),
        grounded=grounded,
        working_share=working_share(before, images),
        out_of_frame=frame_doubt(turned, shifted, spread, numbers) if grounded and not failed else "",
        turned_far=bool(np.median(turned) > numbers.far_deg),
        faults=tuple(map(str, dataset.faults)),
        offset=dataset.body_offset is not None,
        by_gimbal=sum(frame.pose_source == "gimbal" for frame in dataset.frames) > len(dataset) / 2,
        by_positions=_by_positions(dataset, before, after, refined.dataset, placed, method.evidence),
        numbers=numbers,
    )
    return Compared(before, after, placed, turned, shifted, findings)


def _by_positions(
    dataset: Dataset,
    before: Rig,
    after: Rig,
    refined: Dataset,
    placed: NDArray[np.bool_],
    numbers: EvidenceNumbers,
) -> Finding | None:
    """What measured places say of the refined poses; see `Findings`."""
    old = measured_evidence(dataset, before.world_from_cam, placed, numbers)
    new = measured_evidence(refined, after.world_from_cam, placed, numbers)
    if old.positions is None or new.positions is None:
        old, new = replace(old, positions=None), replace(new, positions=None)
    told = new.control is not None and control_believed(new, Cameras.of(after.world_from_cam))
    if old.control is None or not told:
        old, new = replace(old, control=None), replace(new, control=None)
    rigs = [
        (Cameras.of(before.world_from_cam), replace(old, positions=new.positions)),
        (Cameras.of(after.world_from_cam), new),
    ]
    found = [alike for _, alike in measured_misfits(rigs).values()]
    better, worse = any(not alike[0] for alike in found), any(not alike[1] for alike in found)
    if better != worse:
        return "better" if better else "worse"
    stated = new.control is not None or (new.positions is not None and new.positions.stated)
    return "same" if stated else None


def _source_of_poses(dataset: Dataset) -> Literal["given", "seeded", "mixed"]:
    given = sum(frame.pose_source == "given" for frame in dataset.frames)
    if given == len(dataset):
        return "given"
    return "mixed" if given else "seeded"


def _with_images(
    verdict: Verdict,
    scene: Scene,
    gain: Array,
    found: Compared,
    heldout: HeldOutComparison | None,
    method: Method,
) -> Judgement:
    images = scene.images
    trial_psnr, epipolar_px = np.full((2, len(images)), np.nan), np.full((2, len(images)), np.nan)
    if heldout is not None:
        trial_psnr[:, heldout.views] = heldout.before.psnr, heldout.after.psnr
    if found.findings.epipolar is not None and scene.tracks is not None:
        epipolar_px[:] = errors_px(found.before, found.after, scene.tracks)
    before = found.before.world_from_cam
    sharpness = image_flags.sharpness(images, before)
    distance = focus_point(before).mean_distance
    return Judgement(
        verdict=verdict,
        trial_psnr=trial_psnr,
        renders=heldout.renders if heldout is not None else {},
        epipolar_px=epipolar_px,
        sharpness=sharpness,
        gain=gain,
        contradicted=contradicted(epipolar_px[1], method.lost),
        contradicted_before=contradicted(epipolar_px[0], method.lost),
        moved_far=image_flags.moved_far(found.turned, found.shifted, distance, method.verdict),
        blurred=image_flags.blurred(sharpness, method.verdict),
        exposure_off=image_flags.exposure_off(gain, method.verdict),
    )
