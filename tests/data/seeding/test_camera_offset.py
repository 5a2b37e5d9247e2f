"""A common offset of all given poses from the cameras is removed in the caller's world, and named."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from biresnerf.data.formats.read_dataset import read_dataset
from biresnerf.data.formats.transforms.write_transforms import write_transforms
from biresnerf.data.model.dataset import Dataset, Frame, SourceFormat
from biresnerf.data.seeding.map_images import MappedModel
from biresnerf.data.seeding.match_poses import offset_words, without_offset
from biresnerf.data.seeding.seed_poses import seed_poses
from biresnerf.geometry.camera.camera_models import Camera
from biresnerf.geometry.pose_error import rotation_between_deg
from biresnerf.geometry.rigid import rigid_inverse
from biresnerf.geometry.similarity import Similarity
from tests.data.test_real_sets import ROOT
from tests.geometry.rigs import dome, jitter

CASE = ROOT / "interop/50_camera_side_turn"
FLIP = np.diag([1.0, -1, -1, 1])


def turned(*rotvec_deg: float) -> np.ndarray:
    motion = np.eye(4)
    motion[:3, :3] = Rotation.from_rotvec(rotvec_deg, degrees=True).as_matrix()
    return motion


def given_set(poses: np.ndarray, missing: tuple[int, ...] = ()) -> Dataset:
    frames = tuple(
        Frame(
            f"{i}.jpg", Path(f"{i}.jpg"), 0, None if i in missing else pose, None if i in missing else "given"
        )
        for i, pose in enumerate(poses)
    )
    camera = Camera("SIMPLE_PINHOLE", 64, 64, (64.0, 32.0, 32.0))
    return Dataset(Path("."), (camera,), frames, SourceFormat("nerfstudio"))


def model_of(truth: np.ndarray, rows: np.ndarray) -> MappedModel:
    own = Similarity(0.3, turned(20, -50, 110)[:3, :3], np.array([1.0, 2, 3]))
    return MappedModel("incremental", rows, own.apply_to_poses(truth[rows]), {}, 100, 300, 0.5)


def test_given_poses_become_those_of_the_cameras_in_the_world_they_were_in():
    truth = dome(9, np.random.default_rng(1))
    body_from_cam = turned(0, 0, 90)
    dataset = given_set(truth @ rigid_inverse(body_from_cam), missing=(4,))
    found = without_offset(dataset, [model_of(truth, np.array([0, 1, 2, 4, 5, 6, 8]))])
    assert np.flatnonzero(~found.posed).tolist() == [4]
    poses = [pose for frame in found.frames if (pose := frame.world_from_cam) is not None]
    np.testing.assert_allclose(poses, np.delete(truth, 4, axis=0), atol=1e-9)
    assert found.body_offset is not None
    np.testing.assert_allclose(found.body_offset.body_from_cam, body_from_cam, atol=1e-9)
    (words,) = found.warnings
    assert "rolled by 90 degrees" in words


def test_the_poses_of_the_cameras_are_written_and_not_those_that_were_read(tmp_path):
    truth = dome(9, np.random.default_rng(1))
    write_transforms(given_set(truth @ FLIP), truth @ FLIP, tmp_path / "transforms.json")
    rows = json.loads((tmp_path / "transforms.json").read_text())["frames"]
    dataset = given_set(truth @ FLIP)
    frames = tuple(replace(f, raw=row) for f, row in zip(dataset.frames, rows, strict=True))
    found = without_offset(replace(dataset, frames=frames), [model_of(truth, np.arange(9))])
    write_transforms(found, found.world_from_cam, tmp_path / "transforms.json")
    written = json.loads((tmp_path / "transforms.json").read_text())["frames"]
    np.testing.assert_allclose([row["transform_matrix"] for row in written], truth @ FLIP, atol=1e-9)


@pytest.mark.parametrize("dialect", ["nerfstudio", "colmap"])
def test_inverted_matrices_are_inverted_and_said(dialect):
    rng = np.random.default_rng(1)
    truth = jitter(dome(9, rng), rng, 0.1, 0.2)
    axes = FLIP if dialect == "nerfstudio" else np.eye(4)
    inverted = np.linalg.inv(truth @ axes) @ axes  # as read of a file that has the inverses
    dataset = replace(given_set(inverted), source=SourceFormat(dialect))
    found = without_offset(dataset, [model_of(truth, np.arange(9))])
    np.testing.assert_allclose(found.world_from_cam, truth, atol=1e-9)
    assert found.body_offset is None
    (words,) = found.warnings
    assert "look inverted" in words


def test_poses_of_cameras_stay_as_they_are():
    truth = dome(9, np.random.default_rng(1))
    dataset = given_set(truth)
    assert without_offset(dataset, [model_of(truth, np.arange(9))]) is dataset
    assert without_offset(dataset, []) is dataset


def test_an_offset_is_called_by_its_name():
    for dialect, found in (("nerfstudio", "look like OpenCV axes"), ("colmap", "look like OpenGL axes")):
        assert found in offset_words(FLIP, dialect)
    assert "rolled by 180 degrees" in offset_words(turned(0, 0, 180), "tum")
    flange = turned(30, -75, 95)
    assert "turned by 125 degrees about (0.24, -0.60, 0.76)" in offset_words(flange, "tum")
    flange[:3, 3] = [0.3, 0, 0.4]
    assert "shifted by 0.5 units, as those of a robot's flange" in offset_words(flange, "tum")
    assert "all shifted by 0.5 units" in offset_words(
        np.block([[np.eye(3), flange[:3, 3:]], [0, 0, 0, 1]]), "tum"
    )


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "words"), [("flange", "robot's flange"), ("opencv_axes", "look like OpenCV axes")]
)
def test_matches_find_the_cameras_of_bodies_and_of_other_axes(name, words):
    if not CASE.is_dir():
        pytest.skip("no image set interop: set BIRESNERF_TEST_DATA to the folder that holds it")
    pytest.importorskip("pycolmap", reason="needs pycolmap (pip install 'biresnerf[colmap]')")
    dataset = read_dataset(CASE / name)
    truth = json.loads((CASE / f"truth_{name}.json").read_text())
    true = np.stack([truth[file] for file in dataset.file_names]) @ FLIP
    seeding = seed_poses(dataset)
    assert any(words in warning for warning in seeding.dataset.warnings)
    for poses in (seeding.dataset.world_from_cam, *(c.world_from_cam for c in seeding.candidates)):
        assert rotation_between_deg(poses, true).max() < 0.2
        spread = np.linalg.norm(true[:, :3, 3] - true[:, :3, 3].mean(0), axis=1).mean()
        assert np.linalg.norm(poses[:, :3, 3] - true[:, :3, 3], axis=1).max() < 0.02 * spread
