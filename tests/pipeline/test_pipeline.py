"""The whole method on a scene with exact truth: poses are recovered, and all result files agree."""

from __future__ import annotations

import importlib.util
import json
import shutil
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import imageio.v3 as imageio
import numpy as np
import pytest
from PIL import Image

import biresnerf
from biresnerf.data.formats.colmap.read_model import read_colmap_model
from biresnerf.data.formats.read_dataset import read_dataset
from biresnerf.data.formats.transforms.write_transforms import write_transforms
from biresnerf.data.synthetic.scene import synthetic_cameras, write_synthetic_scene
from biresnerf.errors import InputError
from biresnerf.geometry.perturb import perturb_poses
from biresnerf.geometry.pose_error import PoseError, pose_error, rotation_between_deg
from biresnerf.geometry.similarity import Similarity
from biresnerf.options.refine_options import RefineOptions, ResolvedOptions
from biresnerf.pipeline import refine_poses
from biresnerf.progress import Progress
from biresnerf.report import Report
from biresnerf.stages import CHECKPOINT, STAGES
from biresnerf.viewer.report_html import BUNDLE

pytestmark = pytest.mark.slow

VIEWS, HELD_OUT = 30, 3
# The input lies anywhere and has any scale: results must come back into this frame.
INPUT_FROM_TRUTH = Similarity(
    2.5, np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]]), np.array([30.0, -20.0, 7.0])
)
OPTIONS = RefineOptions(
    preset="fast",
    device="cpu",
    start="given",
    steps=1200,
    coarse_steps_min=400,
    coarse_steps_max=700,
    max_image_size=56,
    samples_per_step=8192,
    trial_steps=80,
    pose_rate=0.008,
    pose_rate_final=0.001,
    field_rate=0.02,
    field_rate_final=0.003,
    reconstruction_levels=4,
    reconstruction_resolution_max=256,
    table_size_log2=14,
    orbit_frames=3,
)


@dataclass
class Run:
    """One refinement of noisy poses, with all there is to compare it with; poses are in the input's frame."""

    scene: Path
    output: Path
    truth: np.ndarray
    start: np.ndarray
    report: Report
    progress: list[Progress]

    def refined(self) -> np.ndarray:
        """The poses of the output's transforms.json, read as any program would that finds the images beside it."""
        copy = self.scene / "refined.json"
        shutil.copy(self.output / "transforms.json", copy)
        return read_dataset(copy).world_from_cam

    def errors(self) -> tuple[PoseError, PoseError]:
        return pose_error(self.start, self.truth), pose_error(self.refined(), self.truth)


@pytest.fixture(scope="module")
def run(tmp_path_factory) -> Run:
    scene, output = tmp_path_factory.mktemp("scene"), tmp_path_factory.mktemp("results") / "out"
    path = write_synthetic_scene(scene, VIEWS, 64, seed=1)
    dataset = read_dataset(path)
    truth = INPUT_FROM_TRUTH.apply_to_poses(synthetic_cameras(VIEWS, seed=1))
    start = INPUT_FROM_TRUTH.apply_to_poses(perturb_poses(synthetic_cameras(VIEWS, seed=1), 0.1, seed=6))
    write_transforms(dataset, start, path)
    progress: list[Progress] = []
    report = refine_poses(scene, output, OPTIONS, progress.append)
    return Run(scene, output, truth, start, report, progress)


def test_noisy_poses_come_out_four_times_closer_to_the_truth(run):
    start, end = run.errors()
    assert start.aligned.rotation_deg.mean > 7
    assert end.aligned.rotation_deg.median < 0.25 * start.aligned.rotation_deg.median
    assert end.aligned.centre_percent.median < 0.33 * start.aligned.centre_percent.median
    # In so short a run one camera of thirty may fail to come back; two may not.
    assert end.aligned.rotation_deg.mean < 0.33 * start.aligned.rotation_deg.mean


def test_refined_poses_are_in_the_frame_and_scale_of_the_input(run):
    start, end = run.errors()
    # What is left is the mean of the noise, which no method can know.
    assert end.own_frame.rotation_deg.median < 0.4 * start.own_frame.rotation_deg.median
    assert end.own_frame.centre_percent.median < 0.5 * start.own_frame.centre_percent.median


def test_the_transforms_file_keeps_all_but_the_poses(run):
    given = json.loads((run.scene / "transforms.json").read_text())
    result = json.loads((run.output / "transforms.json").read_text())
    assert result.keys() == given.keys()
    assert result["camera_angle_x"] == given["camera_angle_x"]
    assert [f["file_path"] for f in result["frames"]] == [f["file_path"] for f in given["frames"]]
    assert all(
        a["transform_matrix"] != b["transform_matrix"]
        for a, b in zip(result["frames"], given["frames"], strict=True)
    )


@pytest.mark.skipif(
    importlib.util.find_spec("pycolmap") is None, reason="pycolmap is not installed (extra: colmap)"
)
def test_colmap_reads_the_same_names_cameras_and_poses(run):
    # zlib first: pycolmap's wheels carry their own, and Python's must be bound before (double free otherwise).
    program = """
import zlib, json, sys
import pycolmap
model = pycolmap.Reconstruction(sys.argv[1])
def pose(image):
    cam_from_world = image.cam_from_world
    return (cam_from_world() if callable(cam_from_world) else cam_from_world).matrix().tolist()
print(json.dumps({image.name: [pose(image), model.cameras[image.camera_id].width] for image in model.images.values()}))
"""
    said = subprocess.run(
        [sys.executable, "-c", program, run.output / "colmap/sparse/0"],
        capture_output=True,
        text=True,
        check=True,
    )
    images = json.loads(said.stdout)
    assert sorted(images) == sorted(f"train/r_{i}.png" for i in range(VIEWS))
    for index, world_from_cam in enumerate(run.refined()):
        matrix, width = images[f"train/r_{index}.png"]
        np.testing.assert_allclose(matrix, np.linalg.inv(world_from_cam)[:3], rtol=0, atol=1e-6)
        assert width == 64  # full size, not the working size


def test_the_report_is_valid_and_agrees_with_the_poses(run):
    report = Report.model_validate_json((run.output / "report.json").read_text())
    assert report == run.report
    assert report.state == "complete"
    assert report.steps_done == OPTIONS.steps
    assert 0 < report.switch_step < OPTIONS.steps
    assert report.switch_reason in ("stable", "cap")
    assert report.resumed == 0
    assert report.backend == "cpu"
    assert report.working_size == (56, 56)
    assert report.options == OPTIONS.resolved("cpu")
    assert set(report.seconds) == {"preparing", "coarse", "fine", "evaluating", "adjusting", "judging"}
    refined = run.refined()
    assert [image.name for image in report.images] == [f"./train/r_{i}" for i in range(VIEWS)]
    turned = rotation_between_deg(run.start, refined)
    shifted = np.linalg.norm(run.start[:, :3, 3] - refined[:, :3, 3], axis=1)
    np.testing.assert_allclose([image.moved_deg for image in report.images], turned, atol=1e-3)
    np.testing.assert_allclose([image.moved_units for image in report.images], shifted, atol=1e-4)


def test_held_out_views_are_scored_and_they_alone(run):
    held_out = [image for image in run.report.images if image.held_out]
    assert len(held_out) == HELD_OUT == run.report.heldout.count
    assert all((image.psnr is not None) == image.held_out for image in run.report.images)
    assert run.report.heldout.psnr == pytest.approx(np.mean([image.psnr for image in held_out]))
    assert run.report.heldout.psnr > 17  # far above what the background alone would give
    assert run.report.heldout.ssim > 0.6


def test_the_similarity_in_the_report_carries_optimised_poses_to_the_inputs_frame(run):
    told = run.report.input_from_optimised
    rotation = np.array(told.rotation)
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-9)
    assert 0.8 < told.scale < 1.25


def test_renders_and_the_orbit_can_be_looked_at(run):
    folder = run.output / "renders"
    pictures = sorted(folder.glob("*.png"))
    assert len(pictures) >= 2 * HELD_OUT
    for picture in pictures:
        with Image.open(picture) as image:
            image.load()
            assert min(image.size) >= 56
            assert np.asarray(image).std() > 1
    assert imageio.imread(folder / "orbit.mp4", plugin="FFMPEG", index=0).std() > 1


def test_options_as_used_lie_beside_the_result(run):
    assert ResolvedOptions.model_validate_json((run.output / "config.json").read_text()) == OPTIONS.resolved(
        "cpu"
    )


def test_a_finished_folder_holds_results_only(run):
    names = {path.name for path in run.output.iterdir()}
    packs = {"transforms.json", "colmap", "poses.json", "poses.csv", "tum.txt", "scene.glb"}
    packs |= {"transforms_nerfstudio.json", "points.ply"}
    shown = {"view.json", "view", "thumbnail.jpg", "renders"} | (
        {"report.html"} if (BUNDLE / "report.js").is_file() else set()
    )
    assert names == packs | shown | {"report.json", "config.json", "history.jsonl"}


def test_splatting_has_points_to_start_from(run):
    assert run.report.points is not None
    model = read_colmap_model(run.output / "colmap/sparse/0")
    assert len(model.points) == run.report.points.count > 100


def test_progress_goes_through_the_stages_and_never_falls(run):
    fractions = [progress.fraction for progress in run.progress]
    assert fractions == sorted(fractions)
    assert fractions[-1] == 1.0
    order = [STAGES.index(progress.stage) for progress in run.progress]
    assert order == sorted(order)
    assert {progress.stage for progress in run.progress} == {
        "preparing",
        "coarse",
        "fine",
        "evaluating",
        "exporting",
    }
    assert any(progress.checkpoint == CHECKPOINT.as_posix() for progress in run.progress)


def test_a_finished_folder_is_not_written_to_again(run):
    with pytest.raises(InputError) as caught:
        refine_poses(run.scene, run.output, OPTIONS)
    assert caught.value.code == "output_finished"


def test_a_loaded_result_holds_what_the_files_say(run):
    result = biresnerf.load(run.output)
    assert result.names == tuple(image.name for image in run.report.images)
    assert result.report == run.report
    np.testing.assert_allclose(result.poses, run.refined(), atol=1e-12)
    np.testing.assert_allclose(result.poses_before, run.start, atol=1e-9)
    np.testing.assert_allclose(result.rotated_deg, rotation_between_deg(run.start, result.poses), atol=1e-6)
    assert result.verdict is not None
    assert result.verdict.verdict == "improved"
    steps = result.history["step"]
    assert (np.diff(steps) > 0).all()
    assert set(result.history["stage"]) == {"coarse", "fine"}
