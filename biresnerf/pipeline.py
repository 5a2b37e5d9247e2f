"""The whole method on one screen: read, seed, stage 1, stage 2, evaluate, judge, write."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

from biresnerf.arrays import Array
from biresnerf.compile_kernels import KernelCompilation
from biresnerf.data.formats.positions.control_points import control_points
from biresnerf.data.formats.positions.known_distance import KnownDistance
from biresnerf.data.formats.positions.position_priors import position_priors
from biresnerf.data.formats.read_dataset import read_dataset
from biresnerf.data.given_poses.likely_reading import as_warning, pose_question
from biresnerf.data.given_poses.readings import read_as
from biresnerf.data.model.dataset import Dataset
from biresnerf.data.model.part_of_set import without_photos
from biresnerf.data.parts.join_parts import AskParts
from biresnerf.data.photos.alike.copied_photos import without_copies
from biresnerf.data.photos.guessed_lens import with_shared_predictions
from biresnerf.data.photos.images import load_by_content, load_images
from biresnerf.data.photos.panoramas.cut_panoramas import called_panoramas, cut_panoramas
from biresnerf.data.photos.video.video_frames import VideoReading
from biresnerf.data.points.tracks import Tracks
from biresnerf.data.seeding.cached_mapping import joined_parts
from biresnerf.data.seeding.seed_poses import seed_poses
from biresnerf.errors import Interrupted
from biresnerf.field.backends import resolve_here, use_threads
from biresnerf.forecast.processor_share import ProcessorShare
from biresnerf.forecast.rates import machine_rates, remember_rates
from biresnerf.forecast.run_forecast import TELLING_S, Forecast
from biresnerf.options.refine_options import RefineOptions
from biresnerf.progress import Monitor, OnProgress, Progress, told_before_the_run
from biresnerf.refinement.finish.rounds import run_rounds
from biresnerf.refinement.finish.work_ahead import WorkAhead, expect_run
from biresnerf.refinement.lost.lost_cameras import LostCameraRepair
from biresnerf.refinement.lost.own_matches import OwnMatches
from biresnerf.refinement.optimise.joint_optimiser import JointOptimiser
from biresnerf.refinement.optimise.methods import Method, Recipe
from biresnerf.refinement.parameters.rigid_bodies import rigid_bodies
from biresnerf.refinement.scene.scene import Scene
from biresnerf.refinement.stages.checkpoint import SEEDING, TRACKS, Checkpoint, RunOrigin
from biresnerf.refinement.stages.run_state import RunState
from biresnerf.refinement.stages.two_stages import TwoStages
from biresnerf.refinement.start.choose_start import find_start
from biresnerf.refinement.start.first_step import first_step, memory_needed, stage_lengths
from biresnerf.refinement.verdict.evaluate import Evaluation, evaluate
from biresnerf.refinement.verdict.judgement import judge_poses
from biresnerf.refinement.verdict.pose_uncertainty import pose_uncertainty
from biresnerf.refinement.verdict.run_report import Findings, run_report
from biresnerf.refinement.verdict.so_far import poses_so_far
from biresnerf.refinement.views.evaluation import fit_held_out_poses
from biresnerf.refinement.views.held_out_views import held_out_views
from biresnerf.report import Report
from biresnerf.resume import earlier_work, refuse_other_run, reusable_seeding, run_origin
from biresnerf.stages import Stage
from biresnerf.write.output_folder import OutputFolder
from biresnerf.write.preview import SeedingPreview, write_preview
from biresnerf.write.result import ResultPictures, write_result


@dataclass(frozen=True)
class Observer:
    """Observes a run in progress; the run does not depend on what it sees.

    Attributes:
        at_check: called with the poses [n, 4, 4] at each check; its result joins that check's line of the history.
        at_end: called once, when the poses are final.
    """

    at_check: Callable[[Array], dict[str, float]] = lambda _unit_from_cam: {}
    at_end: Callable[[Scene, JointOptimiser], None] = lambda _scene, _optimiser: None


def refine_poses(
    input: str | Path | Dataset,
    output: str | Path | OutputFolder,
    options: RefineOptions,
    on_progress: OnProgress | None = None,
    should_stop: Callable[[], bool] | None = None,
    observer: Observer | None = None,
    *,
    method: Method | None = None,
    parts: Sequence[Path] = (),
) -> Report:
    """Refine the poses of an image set; all results go to the folder `output`.

    Continues from a checkpoint that a run of the same input and options left in `output`. Begins with stage 2 if a run
    that differs only in options of stage 2 left the end of its stage 1 there.

    Args:
        input: a folder of images (with or without a transforms file), a transforms file, or a set already read.
        output: a folder that is empty, new, or holds an unfinished run of the same input and options. An `OutputFolder`
            says what stays in it, and the report's title.
        on_progress: called with a `Progress` a few times a second.
        should_stop: called after every step, view, frame and photo; once true, a checkpoint and a partial result are
            written.
        observer: observes the run, for comparisons with the truth.
        method: replaces the one that the options name, e.g. ``dataclasses.replace(BIRESNERF, repair=False)``.
        parts: results of parts of the set (`biresnerf.data.parts.cut_set`): poses and matches are taken from them in
            COLMAP's place, and then all cameras are adjusted together.

    Raises:
        InputError: the user can fix it.
        RefinementError: the optimisation diverged.
        Interrupted: stopped by `should_stop`; the checkpoint and a partial result are in `output`, or nothing yet if
            initial poses were still being computed.
    """
    started, share = time.monotonic(), ProcessorShare()
    if isinstance(output, OutputFolder):
        folder = output
    else:
        folder = OutputFolder(
            Path(output), title=_title_of(input.root) if isinstance(input, Dataset) else None
        )
    with folder.held(), share.watching(), KernelCompilation() as kernels:
        setup = _set_up(folder, options, method, on_progress, should_stop, share, kernels)
        setup = replace(setup, parts=tuple(parts))
        return _refine(input, setup, observer or Observer(), started)


def _title_of(root: Path) -> str | None:
    """The set's name, for its report; None for a folder whose name says nothing."""
    name = root.resolve().name
    return None if name in ("", "input", "images") else name


def _refine(input: str | Path | Dataset, setup: _Setup, observer: Observer, started: float) -> Report:
    dataset = input if isinstance(input, Dataset) else _read(Path(input), setup)
    dataset = without_copies(
        without_photos(dataset, setup.asked.leave_out, setup.asked.photos), setup.asked.fixed
    )
    dataset = with_shared_predictions(dataset)
    dataset = _as_meant(dataset, setup)
    dataset = replace(dataset, positions=position_priors(dataset), control=control_points(dataset))
    scene, origin = _seed(dataset, setup)
    setup = replace(setup, recipe=stage_lengths(scene.start, setup.asked, setup.recipe))
    stages = _first_step(scene, origin, setup, observer)
    optimiser, run = stages.optimiser, stages.run
    WorkAhead(scene, optimiser, run).keep_to_budget(started, setup.recipe.options.steps)
    run.spent("preparing", time.monotonic() - started - setup.kernels.waited_s)
    if setup.kernels.waited_s:
        run.spent("compiling", setup.kernels.waited_s)

    evaluation, judgement = Evaluation(), None

    def written(found: Findings) -> Report:
        """The report, after the result."""
        renderer, recipe, at = optimiser.renderer, optimiser.recipe, optimiser.step_state()
        report = run_report(scene, renderer, recipe, at, run.record, stages.repair.repaired, found)
        if (parts := joined_parts(setup.folder.path / SEEDING)) is not None:
            doubts = (*report.warnings, *parts.doubts())
            report = report.model_copy(update={"parts": parts, "warnings": doubts})
        return write_result(
            setup.folder, scene, renderer.joint, setup.monitor, evaluation, report, found.so_far
        )

    try:
        stages.run_stage_1()
        finish = run_rounds(stages, scene)
        observer.at_end(scene, optimiser)
        pictures = ResultPictures(setup.folder, scene)
        recipe, renderer = optimiser.recipe, optimiser.renderer
        with run.timed("evaluating"):
            run.report_evaluation(0.0)
            fit_held_out_poses(optimiser, scene.excluded_from_training)
            evaluation = evaluate(scene, renderer, recipe.options, run, pictures)
        lost = optimiser.camera_errors.lost.cpu().numpy()
        if recipe.options.verdict:
            with run.timed("judging"):
                judgement = judge_poses(
                    scene, renderer, optimiser.sampler, recipe, int(lost.sum()), run, finish
                )
            shown = pictures.write_before_after(evaluation.views, judgement.renders)
            evaluation = replace(evaluation, views=shown)
        told = recipe.method.uncertainty
        known = pose_uncertainty(scene.dataset, renderer.joint, finish, judgement, lost) if told else ()
        report = written(Findings(evaluation.scores, judgement, finish, known))
    except Interrupted:
        so_far = None
        if judgement is None:
            so_far = poses_so_far(scene, optimiser.joint, optimiser.camera_errors, optimiser.recipe, run)
        written(Findings(evaluation.scores, judgement, so_far=so_far))
        raise
    remember_rates(setup.recipe.device.type, setup.recipe.threads, setup.monitor.forecast.measured(TELLING_S))
    return report


@dataclass(frozen=True)
class _Setup:
    """What is known before anything is read.

    Attributes:
        asked: the options as the user gave them.
        recipe: with the options resolved for this machine.
        earlier: work of another run that this one continues.
        parts: results of parts of the set.
    """

    folder: OutputFolder
    asked: RefineOptions
    recipe: Recipe
    earlier: Checkpoint | None
    monitor: Monitor
    kernels: KernelCompilation
    parts: tuple[Path, ...] = ()


def _set_up(
    folder: OutputFolder,
    asked: RefineOptions,
    method: Method | None,
    on_progress: OnProgress | None,
    should_stop: Callable[[], bool] | None,
    share: ProcessorShare,
    kernels: KernelCompilation,
) -> _Setup:
    """Check the folder, find earlier work in it, choose the backend, and begin to compile the kernels."""
    folder.refuse_finished()
    earlier = earlier_work(folder.path)
    options, device = resolve_here(asked)
    threads = use_threads(options.threads)
    forecast = Forecast(machine_rates(device.type, threads).seconds, share.between)
    monitor = Monitor(on_progress or (lambda _progress: None), should_stop or (lambda: False), forecast)
    first = kernels.start(field=device.type == "cpu")
    message = "the first run on a machine compiles kernels, beside what follows" if first else ""
    monitor.report(Progress(stage="preparing", message=message, options=options))
    return _Setup(folder, asked, Recipe.of(options, device, threads, method), earlier, monitor, kernels)


def _read(path: Path, setup: _Setup) -> Dataset:
    watch = told_before_the_run(setup.monitor.report, setup.monitor.should_stop)
    videos = VideoReading(setup.asked.video_frames, watch)
    return read_dataset(path, strict=setup.asked.bad_frames == "refuse", videos=videos)


def _as_meant(dataset: Dataset, setup: _Setup) -> Dataset:
    """The set with given poses read as the user says; else with a warning if they seem to mean something else.

    Panoramas are cut into views.
    """
    options = setup.asked
    dataset = read_as(dataset, options.given_poses)
    if options.panoramas == "all":
        dataset = called_panoramas(dataset)
    question = None if options.given_poses else pose_question(dataset)
    if question is not None:
        dataset = replace(dataset, warnings=(*dataset.warnings, as_warning(question)))
    watch = told_before_the_run(setup.monitor.report, setup.monitor.should_stop)
    return cut_panoramas(
        dataset, setup.folder.path, lambda done: watch(f"{done} panoramas are cut into views")
    )


def _seed(dataset: Dataset, setup: _Setup) -> tuple[Scene, RunOrigin]:
    """The set with initial poses for all its images: those of earlier work, else those that predict photos best."""
    recipe, folder, earlier, monitor = setup.recipe, setup.folder, setup.earlier, setup.monitor
    options = recipe.options
    bodies = rigid_bodies(dataset, options)  # refuses unknown names before anything takes time
    KnownDistance.of(options.known_distance, dataset)  # so does this
    expect_run(monitor.forecast, dataset, setup.asked, recipe)
    with SeedingPreview(dataset, folder, monitor) as preview:
        seeding = seed_poses(
            dataset,
            options.start,
            should_stop=monitor.should_stop,
            seed=options.seed,
            effort=options.seeding_effort,
            remember=folder.path / SEEDING,
            on_progress=preview,
            takes_back_offset=not bodies.tied,
            ask=AskParts(setup.parts) if setup.parts else None,
        )
        preview.show_candidate(seeding)
    load = load_by_content if setup.asked.max_image_size is None else load_images
    images = load(
        seeding.dataset, options.max_image_size, options.background, _photo_counter(len(dataset), setup)
    )
    origin = run_origin(folder.path, dataset, images, recipe)
    watch = told_before_the_run(monitor.report, monitor.should_stop)
    monitor.forecast.pauses(
        setup.kernels.finish(lambda: watch("loading kernels (compiled once on a machine)"))
    )
    if earlier is not None:
        refuse_other_run(folder.path, earlier, origin)
        start, tracks = earlier.start, earlier.tracks
    else:
        folder.path.mkdir(parents=True, exist_ok=True)
        tracks = Tracks.load(folder.path / TRACKS, dataset.names)
        start = find_start(seeding.candidates, seeding.dataset, images, tracks, recipe, monitor)
    held_out = held_out_views(len(dataset), options.holdout, recipe.method.views, start.reliable)
    return Scene(seeding.dataset, images, start, held_out, tracks), origin


def _photo_counter(count: int, setup: _Setup) -> Callable[[int], None]:
    """A callback that reports each tenth of the photos decoded, and can stop the run between two photos."""
    stage: Stage = "seeding" if (setup.folder.path / SEEDING).is_file() else "preparing"
    watch = told_before_the_run(setup.monitor.report, setup.monitor.should_stop, stage)
    return lambda done: watch(f"reading {count} photos: {10 * (10 * done // count)} %")


def _first_step(scene: Scene, origin: RunOrigin, setup: _Setup, observer: Observer) -> TwoStages:
    """The stages before their first step, or where earlier work ended."""
    needed = memory_needed(scene, setup.recipe.method)
    setup.monitor.report(
        Progress(
            stage="seeding" if origin.seeding is not None else "preparing",
            message=f"{len(scene.dataset)} images read{needed}",
            options=setup.recipe.options,
            reusable=reusable_seeding(setup.folder.path) if setup.earlier is None else {},
        )
    )
    optimiser = first_step(scene, setup.recipe)
    repair = LostCameraRepair(optimiser, OwnMatches.of(scene))
    run = RunState(setup.folder.path, scene, origin, setup.monitor)
    preview = partial(write_preview, setup.folder, scene, optimiser, repair, run)
    stages = TwoStages(optimiser, repair, run, observer.at_check, preview)
    if setup.earlier is not None:
        stages.restore(setup.earlier)
        # A partial result may hold these poses: they were measured after the checkpoint was written.
        poses_so_far(scene, optimiser.joint, optimiser.camera_errors, optimiser.recipe, run)
        setup.monitor.report(Progress(stage="preparing", message=f"resuming at step {optimiser.step_index}"))
    WorkAhead(scene, optimiser, run).expect_all()
    return stages
