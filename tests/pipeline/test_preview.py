"""What a running job shows: poses so far and one view, beside every checkpoint."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from biresnerf.data.formats.read_dataset import read_dataset, read_poses
from biresnerf.data.model.dataset import Dataset
from biresnerf.data.synthetic.scene import write_synthetic_scene
from biresnerf.errors import Interrupted
from biresnerf.geometry.perturb import perturb_poses
from biresnerf.geometry.pose_error import pose_error
from biresnerf.options.refine_options import RefineOptions
from biresnerf.pipeline import refine_poses
from biresnerf.progress import Progress
from biresnerf.refinement.optimise.async_metrics import StepResult
from biresnerf.refinement.optimise.joint_optimiser import JointOptimiser
from biresnerf.refinement.stages import two_stages
from biresnerf.refinement.stages.checkpoint import TRACKS
from biresnerf.report import Report
from biresnerf.studies.scenes import with_poses
from tests.refinement.verdict.test_judgement import VIEWS, true_matches

pytestmark = pytest.mark.slow

OPTIONS = RefineOptions(
    preset="fast", device="cpu", start="given", steps=400, max_image_size=32, samples_per_step=4096,
    pose_resolution_max=24, reconstruction_levels=2, reconstruction_resolution_max=256, table_size_log2=12,
    trial_steps=0, orbit_frames=0, checkpoint_every_s=1,
)  # fmt: skip


def test_a_running_refinement_shows_poses_and_a_view_and_a_finished_one_cleans_up(tmp_path):
    scene = write_synthetic_scene(tmp_path / "scene", 8, 32, seed=3)
    output = tmp_path / "out"
    told: list[Progress] = []
    with pytest.raises(Interrupted):
        refine_poses(scene, output, OPTIONS, told.append, lambda: any(p.preview for p in told))
    (shown,) = [p.preview for p in told if p.preview]
    assert set(shown) == {f"preview/{path.name}" for path in (output / "preview").iterdir()}
    poses = json.loads((output / "preview" / "poses.json").read_text())
    assert [image["name"] for image in poses["images"]] == list(read_dataset(scene).names)
    report = Report.model_validate_json((output / "preview" / "report.json").read_text())
    assert (report.state, report.verdict, len(report.images)) == ("partial", None, 8)
    assert report.verdict_so_far is not None, "by matches, of which this run has none"
    assert report.verdict_so_far.heldout is None
    assert 0 < report.steps_done < 400
    so_far = json.loads((output / "preview" / "transforms.json").read_text())
    assert [frame["file_path"] for frame in so_far["frames"]] == list(read_dataset(scene).names)
    np.testing.assert_allclose(np.linalg.det([f["transform_matrix"] for f in so_far["frames"]]), 1, atol=1e-5)
    (render,) = (output / "preview").glob("*_render.png")
    (photo,) = (output / "preview").glob("*_photo.png")
    seen, wanted = (np.asarray(Image.open(p).convert("RGB"), float) / 255 for p in (render, photo))
    assert seen.shape == wanted.shape == (16, 16, 3)
    assert (
        np.abs(seen - wanted).mean() < np.abs(wanted.mean((0, 1)) - wanted).mean()
    )  # closer than one colour
    refine_poses(scene, output, OPTIONS)
    assert not (output / "preview").exists()


@pytest.mark.parametrize("stage", ["evaluating", "exporting"])
def test_a_run_stopped_after_its_last_step_leaves_a_partial_result_and_goes_on(tmp_path, stage):
    scene = write_synthetic_scene(tmp_path / "scene", 6, 24, seed=3)
    output = tmp_path / "out"
    options = OPTIONS.model_copy(update={"steps": 20, "verdict": False, "exports": ("pinhole",)})
    told: list[Progress] = []
    with pytest.raises(Interrupted):
        refine_poses(scene, output, options, told.append, lambda: told[-1].stage == stage)
    partial = Report.model_validate_json((output / "report.json").read_text())
    assert (partial.state, partial.steps_done) == ("partial", 20)
    assert (output / "poses.json").is_file()
    assert not (output / "pinhole").exists(), "no half of a pack"
    assert refine_poses(scene, output, options).state == "complete"
    assert (output / "pinhole" / "sparse" / "0" / "images.bin").is_file()


def test_a_preview_and_what_a_stopped_run_leaves_hold_the_best_poses_and_not_the_last(tmp_path, monkeypatch):
    truth = read_dataset(write_synthetic_scene(tmp_path / "scene", VIEWS, 32, seed=3))
    given = with_poses(truth, perturb_poses(truth.world_from_cam, 0.1, seed=1))
    output = tmp_path / "out"
    (output / TRACKS).parent.mkdir(parents=True)
    with (output / TRACKS).open("wb") as file:
        np.savez(file, names=np.array(truth.names), **true_matches(truth).kept())
    told: list[Progress] = []
    seen: list[float] = []
    real_step = two_stages.step_that_fits

    def wandering_step(optimiser: JointOptimiser) -> StepResult:
        result = real_step(optimiser)
        poses = perturb_poses(truth.world_from_cam, (0.3, 0.01, 0.05, 0.05)[min(len(seen), 3)], seed=1)
        unit = optimiser.frame.unit_from_world.apply_to_poses(poses)
        optimiser.poses.place(torch.from_numpy(unit))
        return result

    def error_deg(folder: Path) -> float:
        poses = np.stack(list(read_poses(folder / "transforms.json").values()))
        return pose_error(poses, truth.world_from_cam).aligned_robust.rotation_deg.mean

    def listen(progress: Progress) -> None:
        told.append(progress)
        if progress.preview:
            seen.append(error_deg(output / "preview"))

    monkeypatch.setattr(two_stages, "step_that_fits", wandering_step)
    given_deg = error_deg_of(given, truth)
    for so_many, returned in ((1, "input"), (3, "refined"), (4, "refined")):  # each goes on from the last
        with pytest.raises(Interrupted):
            refine_poses(given, output, OPTIONS, listen, lambda: len(seen) >= so_many)  # noqa: B023
        report = Report.model_validate_json((output / "report.json").read_text())
        assert (report.state, report.verdict, report.verdict_so_far.returned) == ("partial", None, returned)
        assert error_deg(output) == pytest.approx(seen[-1], abs=1e-4)
        assert (output / "refined").is_dir() == (returned == "input"), "the latest beside the input's"
    assert report.resumed == 2
    assert report.verdict_so_far.verdict == "improved"
    assert seen == pytest.approx([given_deg, *[seen[1]] * 3], abs=1e-4)
    assert seen[1] < given_deg / 5


def error_deg_of(given: Dataset, truth: Dataset) -> float:
    return pose_error(given.world_from_cam, truth.world_from_cam).aligned_robust.rotation_deg.mean
