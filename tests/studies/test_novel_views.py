"""Test views are rendered from where they truly are, and fitted to the field before they are scored."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from biresnerf.geometry.perturb import perturb_poses
from biresnerf.geometry.similarity import Similarity
from biresnerf.refinement.optimise.method_changes import changed
from biresnerf.refinement.views.evaluation import render_view
from biresnerf.refinement.views.image_metrics import psnr
from biresnerf.studies.novel_views import render_test_views
from biresnerf.studies.scenes import with_poses
from tests.refinement.tiny_scene import tiny_optimiser, tiny_options, tiny_set

TRUE_FROM_UNIT = Similarity(
    7.0, Rotation.from_euler("xyz", [20, 50, -30], degrees=True).as_matrix(), np.array([5.0, 6, 7])
)


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """An optimiser, and its set with poses in a world of another place, turn and scale."""
    dataset, images = tiny_set(tmp_path_factory.mktemp("scene"))
    optimiser = tiny_optimiser(dataset, images, tiny_options(steps=200, coarse_steps_max=100))
    for _ in range(60):
        optimiser.step()
    return optimiser, with_poses(dataset, TRUE_FROM_UNIT.apply_to_poses(optimiser.poses.poses().numpy()))


def test_a_view_at_a_training_cameras_true_pose_is_what_that_camera_sees(trained, monkeypatch):
    optimiser, dataset = trained
    monkeypatch.setattr(optimiser, "method", changed(optimiser.method, {"views.fit_steps": 0}))
    expected = render_view(optimiser.renderer, optimiser.poses.matrices().detach()[2], 2).colour
    pairs = list(render_test_views(optimiser, dataset, dataset.world_from_cam))
    np.testing.assert_allclose(pairs[2].render.numpy(), expected, atol=1e-3)
    assert expected.std() > 0.02  # not an even picture, which would be the same from anywhere


def test_fitting_makes_up_for_a_frame_that_is_a_little_off(trained, monkeypatch):
    optimiser, dataset = trained
    off = with_poses(dataset, perturb_poses(dataset.world_from_cam, 0.04, 1))

    def decibels() -> float:
        pairs = render_test_views(optimiser, off, dataset.world_from_cam)
        return float(np.mean([psnr(pair.render, pair.photo) for pair in pairs]))

    found = []
    for steps in (0, 40):
        quick = {"views.fit_rays": 256, "views.fit_steps": steps}
        monkeypatch.setattr(optimiser, "method", changed(optimiser.method, quick))
        found.append(decibels())
    assert found[1] > found[0] + 0.3
