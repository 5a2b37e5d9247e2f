"""Every way to start, on photos with all camera metadata, some of them turned: poses against the truth."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from biresnerf.data.formats.read_dataset import read_dataset
from biresnerf.data.formats.simple.poses_json import read_poses_json
from biresnerf.data.formats.transforms.write_transforms import write_transforms
from biresnerf.data.synthetic.camera_photos import MAKERS
from biresnerf.data.synthetic.captures import turntable_cameras
from biresnerf.data.synthetic.scene import render_synthetic, synthetic_focal, write_blender_set
from biresnerf.geometry.camera.camera_models import Camera
from biresnerf.geometry.perturb import perturb_poses
from biresnerf.geometry.pose_error import PoseError, pose_error
from biresnerf.pipeline import refine_poses
from biresnerf.refinement.optimise.method_changes import changed
from biresnerf.refinement.optimise.methods import BIRESNERF
from biresnerf.refinement.start import choose_start
from biresnerf.report import Report
from tests.data.scenes import plain_features, textured_arc
from tests.refinement.tiny_scene import tiny_run

pytestmark = pytest.mark.slow

needs_colmap = pytest.mark.usefixtures("colmap")
VIEWS, SIZE = 9, 200


@pytest.fixture
def colmap() -> None:
    pytest.importorskip("pycolmap", reason="needs pycolmap (pip install 'biresnerf[colmap]')")


def photos(folder: Path, maker: str, noise: float | None = None, missing: tuple[int, ...] = ()) -> np.ndarray:
    """A set of the arc: without poses, or with noisy ones but for some; returns the true poses."""
    truth = textured_arc(folder / "images", VIEWS, SIZE, MAKERS[maker])
    if noise is None:
        return truth
    bare = read_dataset(folder)
    lens = Camera("SIMPLE_PINHOLE", SIZE, SIZE, (synthetic_focal(SIZE), SIZE / 2, SIZE / 2))
    given = perturb_poses(truth, noise, seed=2)
    write_transforms(
        replace(bare, cameras=(lens,), intrinsics_sources=("given",)), given, folder / "transforms.json"
    )
    document = json.loads((folder / "transforms.json").read_text())
    for i in missing:
        del document["frames"][i]["transform_matrix"]
    (folder / "transforms.json").write_text(json.dumps(document))
    return truth


def refined(
    folder: Path, truth: np.ndarray, start: str, numbers: dict | None = None, **options
) -> tuple[Report, PoseError]:
    asked, method = tiny_run(start=start, verdict=False, **options), changed(BIRESNERF, numbers or {})
    with plain_features():
        report = refine_poses(folder / "set", folder / "out", asked, method=method)
    found = np.tile(np.eye(4), (len(truth), 1, 1))
    found[:, :3] = [image.world_from_cam for image in read_poses_json(folder / "out/poses.json").images]
    return report, pose_error(found, truth)


@needs_colmap
def test_auto_brings_the_poses_of_a_phone_near_the_truth(tmp_path, monkeypatch):
    monkeypatch.setattr(choose_start, "TRIAL_STEPS", 80)
    truth = photos(tmp_path / "set", "android", noise=0.1)
    report, error = refined(tmp_path, truth, "auto", {"start.moving_steps": 120})
    assert {image.pose_source for image in report.images} == {"matches-incremental"}
    assert error.aligned.rotation_deg.median < 2  # of 12


def test_given_poses_of_an_upright_phone_stay_where_they_are_right(tmp_path):
    truth = photos(tmp_path / "set", "iphone-upright", noise=0.0)
    report, error = refined(tmp_path, truth, "given")
    assert {image.pose_source for image in report.images} == {"given"}
    assert error.own_frame.rotation_deg.max < 6  # in so few steps; a wrong turn is 90


@needs_colmap
def test_colmap_alone_finds_the_poses_of_a_drone(tmp_path):
    truth = photos(tmp_path / "set", "drone")
    report, error = refined(tmp_path, truth, "colmap")
    assert {image.pose_source for image in report.images} == {"colmap"}
    assert error.aligned.rotation_deg.median < 5  # in so few steps


def test_without_features_photos_of_a_phone_held_both_ways_are_put_between_their_neighbours(tmp_path):
    truth = photos(tmp_path / "set", "android", noise=0.0, missing=(4,))
    report, error = refined(tmp_path, truth, "none")
    assert [image.pose_source for image in report.images].count("neighbours") == 1
    assert error.own_frame.rotation_deg.max < 9  # of the 90 by which its neighbours are turned


def test_a_turning_scene_before_a_reflex_camera_is_put_on_a_ring(tmp_path):
    shorter = {"start.elevations_deg": (0.0, 30.0, 60.0), "start.ring_steps": 75}
    truth = turntable_cameras(24, uneven=0.2, seed=1)
    pictures = (render_synthetic(pose, 32, 3)[0] for pose in truth)
    write_blender_set(tmp_path / "set", truth, pictures, "dome", MAKERS["reflex"])
    report, error = refined(tmp_path, truth, "turntable", shorter, max_image_size=32)
    assert {image.pose_source for image in report.images} == {"turntable"}
    assert error.aligned.centre_percent.mean < 10  # so few steps do not tell how high the camera stands
