"""The report of a run: all that report.json holds."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np
import torch

from biresnerf.data.model.dataset import Dataset
from biresnerf.data.photos.photo_folders import few_names
from biresnerf.data.points.tracks import Tracks
from biresnerf.data.seeding.initial_poses import InitialPoses
from biresnerf.field.backends import gpu_faults
from biresnerf.geometry.pose_error import camera_errors
from biresnerf.judging.compare import TRIAL, is_better
from biresnerf.refinement.finish.given_poses import accuracy_report, accuracy_warnings
from biresnerf.refinement.finish.outcome import Finish
from biresnerf.refinement.finish.work_ahead import budget_warnings
from biresnerf.refinement.lost.own_matches import LEAST_PAIRS
from biresnerf.refinement.optimise.device_memory import smaller_batches
from biresnerf.refinement.optimise.method_changes import method_warnings
from biresnerf.refinement.optimise.methods import Recipe
from biresnerf.refinement.optimise.optimiser_state import StepState
from biresnerf.refinement.optimise.renderer import Renderer
from biresnerf.refinement.parameters.intrinsics_parameters import FocalCertainty, IntrinsicsParameters
from biresnerf.refinement.parameters.joint_parameters import JointParameters
from biresnerf.refinement.scene.scene import Scene
from biresnerf.refinement.stages.checkpoint import RunRecord
from biresnerf.refinement.start.matches_explained import explained_from_one_place
from biresnerf.refinement.start.refined_poses import RefinedPoses
from biresnerf.refinement.verdict.judgement import Judgement
from biresnerf.refinement.verdict.pose_uncertainty import FIXED
from biresnerf.refinement.verdict.so_far import SoFar
from biresnerf.refinement.views.evaluation import ViewScore
from biresnerf.refinement.views.floaters import unshared_opacity
from biresnerf.report import CameraReport, HeldOut, ImageReport, Report
from biresnerf.uncertainty import PoseUncertainty


@dataclass(frozen=True, eq=False)
class Findings:
    """What was found about the poses by now.

    Attributes:
        scores: of held-out views, as far as they are scored.
        judgement: None where there is no verdict.
        finish: the result of the adjustment of all cameras; None as long as the run is not complete.
        uncertainty: of each image's returned pose, or nothing.
        so_far: the best poses of a run that has no verdict yet; by default the present poses.
    """

    scores: Sequence[ViewScore] = ()
    judgement: Judgement | None = None
    finish: Finish | None = None
    uncertainty: tuple[PoseUncertainty, ...] = ()
    so_far: SoFar | None = None


def run_report(
    scene: Scene,
    renderer: Renderer,
    recipe: Recipe,
    at: StepState,
    record: RunRecord,
    repaired: Collection[int],
    found: Findings = Findings(),
) -> Report:
    """The report of a run as it is ``at`` a step; ``repaired`` are the images whose pose was replaced."""
    from biresnerf import __version__

    finish, judgement, so_far = found.finish, found.judgement, found.so_far
    joint, options, dataset = renderer.joint, recipe.options, scene.dataset
    given = finish.given if finish is not None else None
    refined = so_far.refined if so_far is not None else RefinedPoses.now(dataset, joint)
    return Report(
        version=__version__,
        state="partial" if finish is None else "complete",
        options=options,
        verdict=judgement.verdict if judgement is not None else None,
        verdict_so_far=so_far.verdict if so_far is not None else None,
        images=_image_reports(scene, joint, repaired, refined.world_from_cam, found),
        cameras=camera_reports(dataset, refined.lenses),
        heldout=held_out_report(renderer, scene.excluded_from_training, found.scores)
        if found.scores
        else None,
        start_trials=scene.start.trials,
        candidates=finish.candidates if finish is not None else (),
        input_accuracy=given and accuracy_report(given),
        steps_done=at.step_index,
        switch_step=at.switch if recipe.method.two_stages else None,
        switch_reason=record.switch_reason,
        resumed=record.resumed,
        seconds={stage: round(seconds, 3) for stage, seconds in record.seconds.items()},
        backend=renderer.field.backend,
        device=str(recipe.device),
        threads=recipe.threads,
        working_size=(int(scene.images.widths.max()), int(scene.images.heights.max())),
        input_from_optimised=refined.input_from_optimised.report(),
        faults=dataset.faults,
        warnings=dataset.warnings
        + focal_warnings(dataset, refined.lenses)
        + turntable_warnings(scene.start)
        + accuracy_warnings(given, options)
        + unmatched_warnings(scene)
        + one_place_warnings(scene.tracks, refined, recipe.method.verdict.one_place)
        + method_warnings(recipe)
        + gpu_warnings(recipe.device)
        + smaller_batches(at.batch_share, options.samples_per_step)
        + budget_warnings(options.time_budget_s, record.seconds)
        + _unknown_warnings(dataset, found.uncertainty),
    )


def camera_reports(dataset: Dataset, lenses: IntrinsicsParameters) -> tuple[CameraReport, ...]:
    """The set's cameras before and after refinement."""
    used = [frame.camera for frame in dataset.frames]
    after, parts = lenses.refined(dataset).cameras, lenses.refined_parts
    return tuple(
        CameraReport(
            model=old.model,
            width=old.width,
            height=old.height,
            source=dataset.source_of_intrinsics(i),
            refined=parts[i],
            images=used.count(i),
            params_before=old.params,
            params_after=new.params,
            focal_deviation_percent=_percent(lenses.certainty[i]),
            observable=None if (known := lenses.certainty[i]) is None else known.observable,
        )
        for i, (old, new) in enumerate(zip(dataset.cameras, after, strict=True))
    )


def _percent(known: FocalCertainty | None) -> float | None:
    return None if known is None or known.deviation is None else 100 * known.deviation


def focal_warnings(dataset: Dataset, lenses: IntrinsicsParameters) -> tuple[str, ...]:
    """Warnings on focal lengths that were given and kept, although the evidence clearly prefers others."""
    found = []
    for i, known in enumerate(lenses.certainty):
        if known is None or known.contradicts is None or known.deviation is None:
            continue
        longer = "longer" if known.contradicts > 1 else "shorter"
        name = next(frame.name for frame in dataset.frames if frame.camera == i)
        found.append(
            f"Feature matches fit better with a focal length {abs(known.contradicts - 1):.1%} {longer} than given for "
            f"{name} and the images that share its camera (standard deviation {known.deviation:.2%}). It was kept; "
            "refine_intrinsics=focal has it refined."
        )
    return tuple(found)


def held_out_report(renderer: Renderer, untrained: list[int], scores: Sequence[ViewScore]) -> HeldOut:
    """Means over the held-out views at their present poses, of a field that some views did not train."""
    matrices = renderer.joint.poses.matrices().detach()
    held_out = torch.zeros(len(matrices), dtype=torch.bool, device=renderer.device)
    held_out[untrained] = True
    return HeldOut(
        count=len(scores),
        psnr=float(np.mean([s.psnr for s in scores])),
        ssim=float(np.mean([s.ssim for s in scores])),
        unshared_opacity=float(
            np.mean([unshared_opacity(renderer, held_out, matrices[s.image], s.image) for s in scores])
        ),
    )


def turntable_warnings(start: InitialPoses) -> tuple[str, ...]:
    """A warning where photos do not show which way the table turned; empty where they do, or there was none."""
    if start.source != "turntable":
        return ()
    better, other = start.trials
    if is_better(better.psnr - other.psnr, TRIAL):
        return ()
    return (
        f"The photos hardly show which way the table turned ({better.psnr:.2f} dB, the other way {other.psnr:.2f} dB). "
        "The result may be a mirror image.",
    )


def gpu_warnings(device: torch.device) -> tuple[str, ...]:
    """A warning where the CUDA kernels were not used."""
    faults = gpu_faults(device)
    if not faults:
        return ()
    return (
        f"The CUDA kernels did not pass their check on this GPU ({faults[0]}). Plain torch was used instead, which is "
        "many times slower. docs/cuda.md says what to send.",
    )


def unmatched_warnings(scene: Scene) -> tuple[str, ...]:
    """A warning that names images without tracks that matches did not place, in a set that they mostly placed."""
    tracks, count = scene.tracks, len(scene.dataset)
    observed = np.zeros(count) if tracks is None else np.bincount(tracks.image, minlength=count)
    unmatched = np.flatnonzero(scene.start.unmatched & (observed < LEAST_PAIRS)).tolist()
    if not unmatched:
        return ()
    names = ", ".join(scene.dataset.names[i] for i in unmatched)
    return (
        f"{len(unmatched)} of {count} images have no feature matches; their poses come from the photos alone. Check "
        f"them before you rely on them: {names}.",
    )


def one_place_warnings(tracks: Tracks | None, refined: RefinedPoses, most: float) -> tuple[str, ...]:
    """A warning where rotations alone explain the feature matches, through the refined lenses."""
    if tracks is None or not np.isfinite(refined.world_from_cam).all():
        return ()
    share = explained_from_one_place(refined.dataset, tracks, refined.world_from_cam)
    if share < most:
        return ()
    return (
        f"The photos seem to have been taken from one place, as from a tripod: rotations alone explain {share:.0%} of "
        "the feature matches. Refined rotations can be relied on; positions and scale mean nothing. Move between "
        "photos.",
    )


def _unknown_warnings(dataset: Dataset, uncertainty: tuple[PoseUncertainty, ...]) -> tuple[str, ...]:
    """A warning for each reason why poses are not known, with the images' names."""
    named: dict[str, list[str]] = {}
    for name, pose in zip(dataset.names, uncertainty, strict=bool(uncertainty)):
        if pose.why_unknown is not None and pose.why_unknown != FIXED:
            named.setdefault(pose.why_unknown, []).append(name)
    return tuple(
        f"The accuracy of {len(names)} of {len(dataset)} poses is not known: {why}. Check before you rely on them: "
        f"{few_names(names, 20)}."
        for why, names in named.items()
    )


def _image_reports(
    scene: Scene,
    joint: JointParameters,
    repaired: Collection[int],
    refined: np.ndarray,
    found: Findings,
) -> tuple[ImageReport, ...]:
    exposures = joint.exposure.gains()
    moved = camera_errors(refined, scene.dataset.world_from_cam)
    scored = {score.image: score for score in found.scores}
    return tuple(
        ImageReport(
            name=frame.name,
            pose_source=scene.start.sources[i],
            held_out=i in scene.held_out,
            fixed=bool(joint.bodies.fixed[i]),
            moved_deg=float(moved.rotation_deg[i]),
            moved_units=float(moved.centre[i]),
            uncertainty=found.uncertainty[i] if found.uncertainty else None,
            repaired=i in repaired,
            exposure=None if exposures is None else tuple(exposures[i].tolist()),
            psnr=scored[i].psnr if i in scored else None,
            ssim=scored[i].ssim if i in scored else None,
            **_judged(found.judgement, i),
        )
        for i, frame in enumerate(scene.dataset.frames)
    )


def _judged(judgement: Judgement | None, image: int) -> dict[str, float | bool | None]:
    """What a judgement holds for one image, by the names of `ImageReport`."""
    if judgement is None:
        return {}
    figures = {
        "sharpness": judgement.sharpness[image],
        "gain": judgement.gain[image],
        "trial_psnr_before": judgement.trial_psnr[0, image],
        "trial_psnr_after": judgement.trial_psnr[1, image],
        "epipolar_px_before": judgement.epipolar_px[0, image],
        "epipolar_px_after": judgement.epipolar_px[1, image],
    }
    flags = {
        name: bool(getattr(judgement, name)[image])
        for name in ("contradicted", "moved_far", "blurred", "exposure_off")
    }
    return {name: float(v) if np.isfinite(v) else None for name, v in figures.items()} | flags
