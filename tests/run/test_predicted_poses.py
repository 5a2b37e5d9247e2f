"""Poses and lenses that a network predicted, refined with the photos themselves, of which both are known."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import biresnerf
from biresnerf.data.synthetic.scene import synthetic_focal
from biresnerf.geometry.pose_error import rotation_between_deg
from biresnerf.geometry.similarity import align_by_spread
from tests.data.scenes import textured_arc
from tests.run.test_photos_added import OPTIONS

pytestmark = pytest.mark.slow

pytest.importorskip("pycolmap", reason="needs pycolmap (pip install 'biresnerf[colmap]')")
VIEWS, SIZE = 8, 320


def test_vggts_poses_and_focal_lengths_are_refined_on_the_photos_as_they_were_taken(tmp_path):
    truth = textured_arc(tmp_path / "scene/images", VIEWS, SIZE)
    rng = np.random.default_rng(2)
    poses = truth.copy()
    poses[:, :3, :3] = (
        truth[:, :3, :3] @ Rotation.from_rotvec(np.radians(rng.normal(size=(VIEWS, 3)))).as_matrix()
    )
    poses[:, :3, 3] += 0.03 * rng.normal(size=(VIEWS, 3))
    lens = np.tile(np.array([[1.0, 0, 259], [0, 1, 259], [0, 0, 1]]), (VIEWS, 1, 1))
    focal = synthetic_focal(SIZE)
    lens[:, [0, 1], [0, 1]] = 518 / SIZE * focal * np.exp(0.08 + 0.02 * rng.normal(size=(VIEWS, 1)))
    arrays = {
        "extrinsic": np.linalg.inv(poses)[:, :3],
        "intrinsic": lens,
        "depth": np.zeros((VIEWS, 518, 518, 1)),
    }
    np.savez(tmp_path / "scene/predictions.npz", **arrays)
    result = biresnerf.refine(tmp_path / "scene", tmp_path / "out", **OPTIONS)
    aligned = [align_by_spread(some, truth).apply_to_poses(some) for some in (poses, result.poses)]
    before, after = (np.median(rotation_between_deg(some, truth)) for some in aligned)
    assert after < 0.3 * before
    (found,) = set(result.intrinsics)
    assert (found.width, found.height) == (SIZE, SIZE)
    assert found.full().fx == pytest.approx(focal, rel=0.04), "half as far off as predicted"
