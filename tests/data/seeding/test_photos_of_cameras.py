"""Poses from feature matches for photos with all camera metadata: as exact as without, in the right frame."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from biresnerf.data.formats.read_dataset import read_dataset
from biresnerf.data.model.dataset import Dataset
from biresnerf.data.seeding.seed_poses import seed_poses
from biresnerf.data.synthetic.camera_photos import MAKERS, write_camera_photo
from biresnerf.data.synthetic.scene import SHAPES, random_textures, render_shapes, synthetic_focal
from biresnerf.geometry.camera.camera_models import Camera
from biresnerf.geometry.perturb import perturb_poses
from biresnerf.geometry.pose_error import pose_error
from tests.data.scenes import arc_poses, plain_features, textured_arc

pytestmark = pytest.mark.slow

pytest.importorskip("pycolmap", reason="needs pycolmap (pip install 'biresnerf[colmap]')")
VIEWS, SIZE = 9, 200


@pytest.fixture(scope="module", autouse=True)
def quick():
    with plain_features():
        yield


@pytest.fixture(scope="module", params=MAKERS)
def arc(request, tmp_path_factory) -> tuple[str, Dataset, np.ndarray]:
    """A maker, photos of its camera without poses, and their true ones."""
    folder: Path = tmp_path_factory.mktemp(request.param)
    truth = textured_arc(folder, VIEWS, SIZE, MAKERS[request.param])
    return request.param, read_dataset(folder), truth


def test_given_poses_are_brought_near_the_truth(arc):
    _, bare, truth = arc
    camera = Camera("SIMPLE_PINHOLE", SIZE, SIZE, (synthetic_focal(SIZE), SIZE / 2, SIZE / 2))
    given = perturb_poses(truth, 0.1, seed=2)
    frames = tuple(
        replace(f, world_from_cam=p, pose_source="given") for f, p in zip(bare.frames, given, strict=True)
    )
    noisy = replace(bare, cameras=(camera,), intrinsics_sources=(), frames=frames)
    found = seed_poses(noisy)
    assert [candidate.source for candidate in found.candidates][:2] == ["given", "matches-incremental"]
    assert found.dataset.warnings == bare.warnings
    before, after = (pose_error(c.world_from_cam, truth).aligned.rotation_deg for c in found.candidates[:2])
    assert before.mean > 5
    assert after.max < 3


def test_poses_are_found_from_none_and_gps_that_is_exact_enough_gives_their_frame(arc):
    maker, bare, truth = arc
    found = seed_poses(bare).dataset
    assert {frame.pose_source for frame in found.frames} == {"colmap"}
    assert found.cameras[0].full().fx == pytest.approx(synthetic_focal(SIZE), rel=0.1)
    error = pose_error(found.world_from_cam, truth)
    assert error.aligned.rotation_deg.max < 3
    if maker == "drone":  # east, north and up are told by its positions, the origin is their median
        apart, true = (poses[:, :3, 3] - poses[0, :3, 3] for poses in (found.world_from_cam, truth))
        assert np.linalg.norm(apart - MAKERS[maker].unit_m * true, axis=1).max() < 0.5


def test_each_body_has_its_own_lens_also_if_it_took_two_photos(tmp_path):
    """Two phones of one model: EXIF says one focal length, and one's is 6 % longer."""
    phone, second = MAKERS["android"], (3, 6)
    phone = replace(phone, turns=(1,), serial="A")
    truth, size = arc_poses(VIEWS), 256
    focal = synthetic_focal(size) * np.where(np.isin(np.arange(VIEWS), second), 1.06, 1.0)
    for index, pose in enumerate(truth):
        body = replace(phone, serial="B") if index in second else phone
        shown = render_shapes(SHAPES, random_textures(len(SHAPES), 4), pose, size, size, focal[index])[0]
        shown[shown[..., 3] == 0] = (128, 128, 128, 255)
        write_camera_photo(tmp_path / f"{index:02}.jpg", shown, body, index, synthetic_focal(size), pose)
    dataset = read_dataset(tmp_path)
    assert [frame.camera for frame in dataset.frames] == [int(i in second) for i in range(VIEWS)]
    found = seed_poses(dataset)
    lenses = np.array([camera.params[0] for camera in found.dataset.cameras])
    assert lenses[1] / lenses[0] == pytest.approx(1.06, rel=0.01)
    best = pose_error(found.candidates[0].world_from_cam, truth).aligned_robust
    assert best.centre_percent.max < 1.5
