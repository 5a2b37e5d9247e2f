"""A scene small enough to take many steps of in a test, and an optimiser on it."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np
import torch

from biresnerf.data.formats.read_dataset import read_dataset
from biresnerf.data.model.dataset import Dataset
from biresnerf.data.photos.images import ImageSet, load_images
from biresnerf.data.points.tracks import Tracks
from biresnerf.data.seeding.initial_poses import InitialPoses
from biresnerf.data.synthetic.scene import write_synthetic_scene
from biresnerf.errors import Interrupted
from biresnerf.forecast.run_forecast import Forecast
from biresnerf.options.refine_options import RefineOptions, ResolvedOptions
from biresnerf.progress import Monitor
from biresnerf.refinement.finish.outcome import Finish
from biresnerf.refinement.finish.work_ahead import WorkAhead
from biresnerf.refinement.lost.lost_cameras import LostCameraRepair
from biresnerf.refinement.lost.own_matches import OwnMatches
from biresnerf.refinement.optimise.joint_optimiser import JointOptimiser
from biresnerf.refinement.optimise.methods import Method, Recipe
from biresnerf.refinement.scene.scene import Scene
from biresnerf.refinement.scene.scene_frame import scene_frame
from biresnerf.refinement.stages.checkpoint import RunOrigin
from biresnerf.refinement.stages.run_state import RunState
from biresnerf.refinement.stages.two_stages import TwoStages
from biresnerf.refinement.verdict.judgement import Judgement, judge_poses
from biresnerf.refinement.verdict.run_report import Findings, run_report
from biresnerf.report import Report

CPU = torch.device("cpu")


def tiny_run(**changed) -> RefineOptions:
    """Options of a run of 40 steps: stage 2 from step 20."""
    values = {
        "preset": "fast",
        "device": "cpu",
        "threads": 2,
        "steps": 40,
        "coarse_steps_min": 10,
        "coarse_steps_max": 20,
        "check_every": 5,
        "max_image_size": 24,
        "samples_per_step": 4096,
        "pose_resolution_max": 24,
        "reconstruction_resolution_min": 32,
        "reconstruction_resolution_max": 64,
        "reconstruction_levels": 3,
        "table_size_log2": 12,
        "warmup_steps": 10,
        "holdout": 1,
        "orbit_frames": 0,
    }
    return RefineOptions(**{**values, **changed})


def tiny_options(**changed) -> ResolvedOptions:
    """The same, resolved."""
    return tiny_run(**changed).resolved("cpu")


def tiny_recipe(method: Method | None = None, **changed) -> Recipe:
    """These, and how they are trained here."""
    return Recipe.of(tiny_options(**changed), CPU, 2, method)


def tiny_set(folder: Path, views: int = 7, size: int = 24) -> tuple[Dataset, ImageSet]:
    """The synthetic scene with true poses, read back."""
    dataset = read_dataset(write_synthetic_scene(folder, views, size, seed=3))
    return dataset, load_images(dataset, size)


def tiny_optimiser(
    dataset: Dataset,
    images: ImageSet,
    options: ResolvedOptions,
    held_out: list[int] | None = None,
    method: Method | None = None,
) -> JointOptimiser:
    recipe = Recipe.of(options, CPU, 2, method)
    frame = scene_frame(dataset.world_from_cam, images, recipe.method.scene)
    start = frame.unit_from_world.apply_to_poses(dataset.world_from_cam)
    return JointOptimiser(images, frame, start, recipe, held_out or [])


def given_scene(
    dataset: Dataset, images: ImageSet, held_out: list[int] | None = None, given: np.ndarray | None = None
) -> Scene:
    """The set as a run has it that starts from its own poses, or from others."""
    poses = dataset.world_from_cam if given is None else given
    start = InitialPoses(poses, "given", ("given",) * len(dataset))
    return Scene(dataset, images, start, held_out or [])


def true_matches(dataset: Dataset, noise_px: float = 0.1) -> Tracks:
    """Where random points of the scene lie in pairs of photos, by the true poses, and noise."""
    rng, views = np.random.default_rng(7), len(dataset)
    points = rng.uniform(-0.5, 0.5, (600, 3))
    pair = rng.integers(0, views, (600, 2))
    pair[:, 1] = (pair[:, 0] + 1 + pair[:, 1] % (views - 1)) % views
    full = dataset.camera_of(0).full()
    xy = np.empty((600, 2, 2))
    for side in (0, 1):
        poses = dataset.world_from_cam[pair[:, side]]
        in_cam = np.einsum("mji,mj->mi", poses[:, :3, :3], points - poses[:, :3, 3])
        xy[:, side] = in_cam[:, :2] / in_cam[:, 2:] * [full.fx, full.fy] + [full.cx, full.cy]
    tracks = Tracks.of_matches(pair, xy + rng.normal(0, noise_px, xy.shape))
    assert tracks is not None
    return tracks


class TinyRun:
    """The parts of a run, as the pipeline makes them."""

    def __init__(
        self,
        optimiser: JointOptimiser,
        scene: Scene,
        folder: Path,
        monitor: Monitor | None = None,
        **watching,
    ) -> None:
        self.optimiser, self.scene, self.folder = optimiser, scene, folder
        self.state = RunState(folder, scene, RunOrigin(), monitor or Monitor())
        self.repair = LostCameraRepair(optimiser, OwnMatches.of(scene))
        self.stages = TwoStages(optimiser, self.repair, self.state, **watching)

    @property
    def parts(self) -> tuple[Scene, JointOptimiser, RunState]:
        """As most functions take them."""
        return self.scene, self.optimiser, self.state

    @property
    def ahead(self) -> WorkAhead:
        return WorkAhead(*self.parts)

    def judged(self, finish: Finish = Finish()) -> Judgement:
        """What is found about its poses."""
        made = self.optimiser
        lost = int(made.camera_errors.lost.sum())
        return judge_poses(self.scene, made.renderer, made.sampler, made.recipe, lost, self.state, finish)

    def report(self, found: Findings | None = None) -> Report:
        made, repaired = self.optimiser, self.repair.repaired
        at, record = made.step_state(), self.state.record
        return run_report(self.scene, made.renderer, made.recipe, at, record, repaired, found or Findings())

    @property
    def forecast(self) -> Forecast:
        return self.state.monitor.forecast

    def end_in(self, seconds: float) -> None:
        self.state.keep_to(self.state.replan, time.monotonic() + seconds)


def finished(run: TinyRun) -> bool:
    """Run both stages; false if they were stopped."""
    try:
        run.stages.run_stage_1()
        run.stages.run_stage_2()
    except Interrupted:
        return False
    return True


def photos_set(photos: list[np.ndarray]) -> ImageSet:
    """An `ImageSet` of these uint8 [h, w, 3] arrays; cameras do not matter."""
    from biresnerf.geometry.camera.camera_models import Camera

    heights, widths = [p.shape[0] for p in photos], [p.shape[1] for p in photos]
    return ImageSet(
        pixels=np.concatenate([p.reshape(-1, 3) for p in photos]),
        alpha=None,
        offsets=np.cumsum([0, *(h * w for h, w in zip(heights, widths, strict=True))]),
        widths=np.array(widths, np.int32),
        heights=np.array(heights, np.int32),
        cameras=tuple(
            Camera("SIMPLE_PINHOLE", w, h, (20.0, w / 2, h / 2)) for h, w in zip(heights, widths, strict=True)
        ),
        background=None,
    )
