"""Poses by feature matches for photos with all that cameras write: as exact as for bare ones, in the right frame."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from biresnerf.data.formats.read_dataset import read_dataset
from biresnerf.data.model.dataset import Dataset
from biresnerf.data.seeding.seed_poses import seed_poses
from biresnerf.data.synthetic.camera_photos import MAKERS
from biresnerf.data.synthetic.scene import synthetic_focal
from biresnerf.geometry.camera.camera_models import Camera
from biresnerf.geometry.perturb import perturb_poses
from biresnerf.geometry.pose_error import pose_error
from tests.data.scenes import plain_features, textured_arc

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
