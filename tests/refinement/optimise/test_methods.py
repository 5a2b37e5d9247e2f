"""Every method runs to its end on the same loop, and resumes after a stop as if there had been none."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import get_args

import numpy as np
import pytest
import torch

from biresnerf.data.synthetic.scene import write_synthetic_scene
from biresnerf.geometry.lie import so3_exp
from biresnerf.geometry.pose_error import camera_errors
from biresnerf.geometry.similarity import align_robust
from biresnerf.options.presets import METHOD_VALUES, PRESETS, MethodName
from biresnerf.options.refine_options import RefineOptions
from biresnerf.pipeline import refine_poses
from biresnerf.progress import Monitor, Progress
from biresnerf.refinement.optimise.methods import find_method
from biresnerf.refinement.stages.checkpoint import load_checkpoint
from biresnerf.report import Report
from biresnerf.studies.baselines import methods as baselines
from tests.refinement.tiny_scene import TinyRun, finished, given_scene, tiny_optimiser, tiny_run, tiny_set

pytestmark = pytest.mark.slow

SMALL_GRID = {
    "reconstruction_levels": 8,
    "reconstruction_resolution_min": 8,
    "reconstruction_resolution_max": 64,
}
FEW_SAMPLES = {"samples_per_step": 1024}
NARROW = 16  # units of BARF's network here, which is as deep as ever
METHODS = get_args(MethodName)
EACH = pytest.mark.parametrize("method", METHODS)


def small_options(method: str, **changed) -> RefineOptions:
    """As `tiny_run`, 20 steps with the switch after 10, for a method."""
    steps = {"steps": 20, "coarse_steps_min": 10, "coarse_steps_max": 10, "max_image_size": 16}
    small = SMALL_GRID if method == "baa-ngp" else FEW_SAMPLES if find_method(method).large_network else {}
    return tiny_run(method=method, **{**steps, **small, **changed})


@pytest.fixture(autouse=True, scope="module")
def narrow_network():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(baselines, "BARF_HIDDEN", NARROW)
        yield


@dataclass
class Run:
    report: Report
    progress: list[Progress]


@pytest.fixture(scope="module")
def scene(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("scene")
    write_synthetic_scene(folder, 6, 16, seed=3)
    return folder


@pytest.fixture(scope="module", params=METHODS)
def run(request, scene, tmp_path_factory) -> Run:
    told: list[Progress] = []
    output = tmp_path_factory.mktemp("results") / "out"
    options = small_options(request.param, holdout=1)
    return Run(refine_poses(scene, output, options, told.append), told)


def test_a_run_goes_from_photos_to_a_complete_report_that_names_the_method(run):
    report = run.report
    method = find_method(report.options.method)
    assert report.state == "complete"
    assert report.steps_done == 20
    assert report.heldout.count == 1
    assert np.isfinite(report.heldout.psnr)
    assert 0 < max(image.moved_deg for image in report.images) < 10
    assert report.switch_step == (10 if method.two_stages else None)
    assert (report.switch_reason is None) == (not method.two_stages)


def test_progress_tells_the_stages_a_method_has_and_never_falls(run):
    method = find_method(run.report.options.method)
    stages = {progress.stage for progress in run.progress}
    assert "fine" in stages
    assert method.two_stages or "coarse" not in stages
    fractions = [progress.fraction for progress in run.progress]
    assert fractions == sorted(fractions)
    assert fractions[-1] == 1.0


def test_every_method_that_can_be_chosen_is_found_and_no_baseline_is_loaded_before():
    assert all(find_method(name).loss for name in METHODS)
    code = "import biresnerf.pipeline, sys; print(*(name for name in sys.modules if 'studies' in name))"
    loaded = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert loaded.stdout.split() == []


@EACH
def test_a_stopped_and_resumed_run_ends_bit_for_bit_as_an_uninterrupted_one(tmp_path, method):
    dataset, images = tiny_set(tmp_path / "scene", views=4, size=16)
    options = small_options(method).resolved("cpu")

    def begun(stop_at: int | None) -> TinyRun:
        optimiser = tiny_optimiser(dataset, images, options, held_out=[1])
        stop = lambda: optimiser.step_index == stop_at  # noqa: E731
        return TinyRun(optimiser, given_scene(dataset, images, [1]), tmp_path, Monitor(should_stop=stop))

    whole = begun(None)
    assert finished(whole)
    assert not finished(begun(13))
    resumed = begun(None)
    resumed.stages.restore(load_checkpoint(tmp_path))
    assert finished(resumed)
    state = resumed.optimiser.state()
    for name, tensor in whole.optimiser.state().items():
        assert torch.equal(state[name], tensor), name


@EACH
def test_held_out_photos_never_reach_the_field(tmp_path, method):
    from dataclasses import replace

    dataset, images = tiny_set(tmp_path, views=4, size=16)
    fields = []
    for shade in (0, 255):
        photos = images.pixels.copy()
        photos[images.offsets[2] : images.offsets[3]] = shade
        optimiser = tiny_optimiser(
            dataset, replace(images, pixels=photos), small_options(method).resolved("cpu"), [2]
        )
        for _ in range(
            2
        ):  # the third has as many rays as the second's samples allow, also those of held-out photos
            optimiser.step()
        fields.append(optimiser.field.state())
    for name, tensor in fields[0].items():
        assert torch.equal(fields[1][name], tensor), name


@pytest.mark.parametrize("method", ["biresnerf", "biresnerf-paper", "baa-ngp"])
def test_a_camera_that_strays_from_a_formed_field_comes_back(tmp_path, method):
    dataset, images = tiny_set(tmp_path, views=10)
    steps = {"steps": 400, "coarse_steps_min": 400, "coarse_steps_max": 400, "max_image_size": 24}
    optimiser = tiny_optimiser(dataset, images, small_options(method, holdout=0, **steps).resolved("cpu"))
    optimiser.poses_held = True
    for _ in range(150):
        optimiser.step()
    optimiser.poses_held = False
    strayed_rad = 0.08
    with torch.no_grad():
        optimiser.poses.start[4] = (
            so3_exp(torch.tensor([[0.0, 0, strayed_rad]]))[0] @ optimiser.poses.start[4]
        )
    for _ in range(60):
        optimiser.step()
    truth = optimiser.frame.unit_from_world.apply_to_poses(dataset.world_from_cam)
    found = optimiser.poses.poses().numpy()
    aligned = align_robust(found, truth, with_rotations=True).apply_to_poses(found)
    assert camera_errors(aligned, truth).rotation_deg[4] < 0.75 * np.degrees(strayed_rad)


def test_a_method_keeps_its_published_rates_and_grid_in_every_preset_and_yields_to_what_is_asked():
    for preset in PRESETS:
        for method, values in METHOD_VALUES.items():
            options = RefineOptions(preset=preset, method=method).resolved("cpu")
            assert {key: getattr(options, key) for key in values} == values
    asked = RefineOptions(preset="paper", method="baa-ngp", pose_rate=2e-3, double_pose_step=False).resolved(
        "cpu"
    )
    assert (asked.pose_rate, asked.double_pose_step, asked.pose_rate_final) == (2e-3, False, 1e-5)


def test_the_paper_preset_has_each_method_at_its_published_length_and_batch():
    def of(method):
        options = RefineOptions(preset="paper", method=method).resolved("cpu")
        return options.steps, options.samples_per_step, options.table_size_log2

    assert of("baa-ngp") == of("biresnerf-paper") == of("biresnerf") == (40_000, 2**18, 19)
    assert of("barf")[:2] == (200_000, 1024 * 128)
    assert of("nerfacc-barf")[0] == 200_000
    assert RefineOptions(preset="fast", method="barf").resolved("cpu").steps == PRESETS["fast"]["steps"]
