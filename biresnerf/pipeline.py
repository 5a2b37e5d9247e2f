"""The whole method on one screen: read -> prepare -> stage 1 -> stage 2 -> evaluate -> judge -> write."""

from __future__ import annotations

import hashlib
import json
import logging
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import torch
from torch import Tensor

from biresnerf.data.formats.read_dataset import read_dataset
from biresnerf.data.model.dataset import Dataset
from biresnerf.data.photos.images import ImageSet, load_images
from biresnerf.data.points.feature_matches import FeatureMatches
from biresnerf.data.seeding.seed_poses import PoseCandidate, seed_poses
from biresnerf.errors import InputError, Interrupted
from biresnerf.field.backends import resolve_here, use_threads
from biresnerf.field.cpu.compile_kernels import compile_kernels
from biresnerf.options.refine_options import RESULT_OPTIONS, STAGE_1_OPTIONS, RefineOptions, ResolvedOptions
from biresnerf.progress import OnProgress, Progress
from biresnerf.refine.optimise.joint_optimiser import JointOptimiser
from biresnerf.refine.parameters.intrinsics_parameters import lenses_of
from biresnerf.refine.parameters.rigid_bodies import rigid_bodies
from biresnerf.refine.scene.scene_depth import matched_depth
from biresnerf.refine.scene.scene_frame import scene_frame
from biresnerf.refine.stages.checkpoint import COARSE, load_checkpoint
from biresnerf.refine.stages.history import Observer
from biresnerf.refine.stages.two_stages import TwoStages
from biresnerf.refine.start.choose_start import Start, choose_start
from biresnerf.refine.start.forward_facing import find_forward_facing
from biresnerf.refine.verdict.run_input import RunInput
from biresnerf.refine.views.held_out_views import held_out_views
from biresnerf.report import Report
from biresnerf.write.finish_run import Run
from biresnerf.write.output_folder import OutputFolder
from biresnerf.write.show_seeding import ShowSeeding

logger = logging.getLogger(__name__)

MATCHED_IMAGES, MATCHED_XY = "matches.images", "matches.xy"  # in a checkpoint


@dataclass(frozen=True, eq=False)
class Prepared:
    """Everything read, before the first step."""

    dataset: Dataset
    images: ImageSet
    fingerprint: str
    stage_1_fingerprint: str
    candidates: tuple[PoseCandidate, ...]
    seeding: str | None  # what COLMAP answered, where it was asked


def refine_poses(
    input: Path | Dataset,
    output: Path,
    options: RefineOptions,
    on_progress: OnProgress | None = None,
    should_stop: Callable[[], bool] | None = None,
    observer: Observer | None = None,
    *,
    keep_reusable: bool = False,
) -> Report:
    """Refine the poses of an image set; all results go to the folder `output`.

    Goes on by itself where a run of the same input and options left a checkpoint in `output`, and begins with stage 2
    where one that differs in options of stage 2 alone left the end of its stage 1 there.

    Args:
        input: a folder of images (with or without a transforms file), a transforms file, or a set already read.
        output: a folder that is empty, new, or holds an unfinished run of the same input and options.
        on_progress: called with a `Progress` a few times a second.
        should_stop: asked after every step, view, frame and photo; once true, checkpoint and partial result are
            written.
        observer: looks into the run, for comparisons with the truth.
        keep_reusable: leave in `output`/checkpoint what other runs of the set can start from.

    Raises:
        InputError: the user can fix it.
        RefinementError: the optimisation diverged.
        Interrupted: stopped by `should_stop`; the checkpoint and a partial result are in `output`, or nothing
            yet where poses to start from were still being looked for.
    """
    report = on_progress or (lambda _progress: None)
    folder = OutputFolder(output, keep_reusable=keep_reusable)
    run = _begin(input, folder, options, report, should_stop or (lambda: False), observer)
    stages = run.stages
    if not stages.run():
        run.write("partial")
        raise Interrupted(f"stopped at step {stages.optimiser.step_index}; run again to go on")
    try:
        run.evaluate()
        if observer is not None:
            observer.at_end(stages.optimiser)
        run.judge()
        return run.write("complete")
    except Interrupted:
        run.write("partial")
        raise


def _begin(
    input: Path | Dataset,
    folder: OutputFolder,
    asked: RefineOptions,
    report: OnProgress,
    stop: Callable[[], bool],
    observer: Observer | None,
) -> Run:
    """Read, prepare, choose where to start or take up a checkpoint: all up to the first step."""
    started = time.monotonic()
    folder.refuse_finished()
    checkpoint = load_checkpoint(folder.path)
    stage_1 = load_checkpoint(folder.path, COARSE) if checkpoint is None else None
    report(Progress(stage="preparing"))
    options, device, threads = _choose_backend(asked, report)
    unstarted: dict[str, Any] = {"fingerprint": None, "seeding": None}
    begun = checkpoint or stage_1
    notes = begun[1] if begun is not None else unstarted
    folder.restore_seeding(notes["seeding"])
    prepared = _prepare(input, options, folder, report, stop)
    folder.claim(prepared.fingerprint, notes["fingerprint"] if stage_1 is None else None)
    if stage_1 is not None and notes["stage_1_fingerprint"] != prepared.stage_1_fingerprint:
        raise InputError(
            "stage_1_not_usable",
            "is of other images, poses or options, or of another kind of device.",
            where=COARSE.as_posix(),
            hint="Start from its seeding, or from the beginning.",
        )
    if begun is not None:
        start = Start.from_json(notes["start"])
    else:
        start = _find_start(prepared, options, device, threads, report, stop)
    options = start.stage_lengths(asked, options)
    message = f"{len(prepared.dataset)} images read"
    stage: Literal["seeding", "preparing"] = "seeding" if prepared.seeding is not None else "preparing"
    reusable = folder.seeding_files() if begun is None else {}
    report(Progress(stage=stage, fraction=0.02, message=message, reusable=reusable, options=options))

    given = RunInput(
        prepared.dataset,
        prepared.images,
        start,
        held_out_views(len(prepared.dataset), options.holdout, start.sound),
        _matches(folder, prepared.dataset, begun),
    )
    optimiser = _optimiser(given, options, device, threads)
    stages = TwoStages(
        optimiser, folder.path, prepared.fingerprint, report, stop, prepared.seeding, start.as_json(), observer,
        lambda: folder.write_preview(given, stages, threads),
        _carried(given.matches), prepared.stage_1_fingerprint,
    )  # fmt: skip
    if checkpoint is not None:
        stages.resume(*checkpoint)
        logger.info("going on from step %d", optimiser.step_index)
    elif stage_1 is not None:
        stages.begin_stage_2(*stage_1)
        logger.info("stage 2 begins at step %d of another run", optimiser.step_index)
    stages.record.seconds["preparing"] = time.monotonic() - started
    return Run(given, stages, folder, threads, report, stop)


def _matches(
    folder: OutputFolder, dataset: Dataset, checkpoint: tuple[dict[str, Tensor], dict[str, Any]] | None
) -> FeatureMatches | None:
    """The feature matches that the search for a start came by, from the checkpoint where there is one."""
    if checkpoint is None:
        return FeatureMatches.load(folder.matches, dataset.names)
    tensors = checkpoint[0]
    if MATCHED_IMAGES not in tensors:
        return None
    return FeatureMatches.of(tensors[MATCHED_IMAGES].numpy(), tensors[MATCHED_XY].numpy())


def _carried(matches: FeatureMatches | None) -> dict[str, Tensor]:
    """The same for checkpoints."""
    if matches is None:
        return {}
    images, xy = matches.kept()
    return {MATCHED_IMAGES: torch.from_numpy(images), MATCHED_XY: torch.from_numpy(xy)}


def _optimiser(
    given: RunInput, options: ResolvedOptions, device: torch.device, threads: int
) -> JointOptimiser:
    """The optimisation at its first step, in the unit frame of the poses it starts from."""
    dataset, images, start = given.dataset, given.images, given.start
    bodies = rigid_bodies(dataset, options)
    world_from_cam = bodies.held(start.world_from_cam, dataset.world_from_cam)
    frame = scene_frame(world_from_cam, images, matched_depth(dataset, world_from_cam, given.matches))
    poses = frame.unit_from_world.apply_to_poses(world_from_cam)
    lenses = lenses_of(
        dataset, images, options.refine_intrinsics, given.untaught, device, dollies=not bodies.tied
    )
    optimiser = JointOptimiser(
        images, frame, poses, options, given.untaught, device, threads, start.mobility, bodies, lenses
    )
    optimiser.camera_errors.doubt(start.doubted)
    return optimiser


def _choose_backend(asked: RefineOptions, report: OnProgress) -> tuple[ResolvedOptions, torch.device, int]:
    """The options resolved for the device there is, that device, and the threads taken; kernels compiled."""
    options, device = resolve_here(asked)
    threads = use_threads(options.threads)
    message = "loading kernels (the first run compiles them)" if device.type == "cpu" else ""
    report(Progress(stage="preparing", fraction=0.005, message=message, options=options))
    if device.type == "cpu":
        compile_kernels()
    return options, device, threads


def _find_start(
    prepared: Prepared,
    options: ResolvedOptions,
    device: torch.device,
    threads: int,
    report: OnProgress,
    stop: Callable[[], bool],
) -> Start:
    """The poses that predict unseen photos best, where there is a choice."""
    candidates = [Start.of(candidate) for candidate in prepared.candidates]
    if candidates[0].source == "forward-facing":
        message = "looking for poses without features"
        report(Progress(stage="seeding", fraction=0.016, message=message))
        found = find_forward_facing(prepared.images, options, device, threads, stop)
        return replace(candidates[0], world_from_cam=found)
    if len(candidates) == 1:
        return candidates[0]
    report(Progress(stage="seeding", fraction=0.016, message=f"trying {len(candidates)} sets of poses"))
    return choose_start(candidates, prepared.images, options, device, threads, stop)


def _prepare(
    given: Path | Dataset,
    options: ResolvedOptions,
    folder: OutputFolder,
    report: OnProgress,
    stop: Callable[[], bool],
) -> Prepared:
    dataset = given if isinstance(given, Dataset) else read_dataset(Path(given))
    rigid_bodies(dataset, options)  # names that are not there are told before anything takes time
    given_poses = [None if f.world_from_cam is None else f.world_from_cam.tolist() for f in dataset.frames]
    with ShowSeeding(dataset, folder, report) as show:
        found = seed_poses(
            dataset,
            options.start,
            should_stop=stop,
            seed=options.seed,
            effort=options.seeding_effort,
            remember=folder.seeding,
            on_progress=show,
        )
        show.end(found)
    dataset = found.dataset
    images = load_images(dataset, options.max_image_size, options.background)
    digest = hashlib.sha256(images.pixels.tobytes())
    if images.counts is not None:
        digest.update(images.counts.tobytes())
    asked = options.model_dump(include=set(RESULT_OPTIONS))
    stage_1 = options.model_dump(include=set(STAGE_1_OPTIONS))
    return Prepared(
        dataset,
        images,
        _fingerprint(digest, asked, dataset.names, given_poses),
        _fingerprint(digest, stage_1, dataset.names, given_poses),
        found.candidates,
        folder.kept_seeding(),
    )


def _fingerprint(photos: hashlib._Hash, *said: Any) -> str:
    """Of a set's photos and what is asked for of them."""
    digest = photos.copy()
    digest.update(json.dumps(said, sort_keys=True).encode())
    return digest.hexdigest()
