"""How much of what a view renders lies where fewer than two training cameras look, on walls and fog of known share."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from biresnerf.data.synthetic.scene import CAMERA_ANGLE_X
from biresnerf.geometry.similarity import Similarity
from biresnerf.refinement.optimise.joint_optimiser import JointOptimiser
from biresnerf.refinement.optimise.methods import Recipe
from biresnerf.refinement.scene.scene_frame import SceneFrame
from biresnerf.refinement.verdict.run_report import held_out_report
from biresnerf.refinement.views.evaluation import score_views
from biresnerf.refinement.views.floaters import unshared_opacity
from tests.refinement.analytic_field import AnalyticField
from tests.refinement.tiny_scene import CPU, tiny_options, tiny_set

HALF = math.tan(CAMERA_ANGLE_X / 2)
APART = 0.2
EYE = torch.tensor([0.0, 0.0, -0.95])


@pytest.fixture(scope="module")
def images(tmp_path_factory):
    return tiny_set(tmp_path_factory.mktemp("scene"))[1]


def optimiser_of(images, formula, held_out=()) -> JointOptimiser:
    """Cameras 0 and 1 side by side look along z; 2 is where 0 is; the others look the other way."""
    poses = np.tile(np.eye(4), (len(images), 1, 1))
    poses[:, 2, 3] = float(EYE[2])
    poses[1, 0, 3] = APART
    poses[3:, :3, :3] = np.diag([-1.0, 1.0, -1.0])
    frame = SceneFrame(Similarity.identity(), True, 1.0, 1e-3, 60.0, None)
    optimiser = JointOptimiser(images, frame, poses, Recipe.of(tiny_options(), CPU, 2), list(held_out))
    optimiser.field = AnalyticField(formula, unbounded=True)
    return optimiser


def share(optimiser: JointOptimiser, image: int) -> float:
    pose, held_out = optimiser.poses.matrices().detach()[image], optimiser.camera_errors.held_out
    return unshared_opacity(optimiser.renderer, held_out, pose, image)


def wall(z: float):
    return lambda points: torch.where(points[:, 2] - EYE[2] > z, 1e4, 0.0)


@pytest.mark.parametrize("z", [0.6, 1.0, 1.6])
def test_on_a_wall_it_is_what_the_neighbours_image_does_not_show(images, z):
    beside = APART / (2 * z * HALF)  # two frusta of width 2 z tan, moved against each other
    optimiser = optimiser_of(images, wall(z), held_out=[2, 3])
    half_a_column = 0.5 / 12  # of 24, every second is looked at
    assert share(optimiser, 0) == pytest.approx(beside, abs=half_a_column + 0.005)
    assert share(optimiser, 2) == share(optimiser, 0)


def test_a_view_out_of_training_is_no_witness(images):
    alone = optimiser_of(images, wall(1.0), held_out=[1, 2])
    assert share(alone, 0) == 1.0
    assert share(optimiser_of(images, wall(1.0), held_out=[3]), 0) == 0.0  # cameras 0 and 2 see the same


@pytest.mark.parametrize("alpha", [0.1, 0.5])
def test_fog_before_one_camera_counts_by_its_opacity(images, alpha):
    def formula(points):
        distance = (points - EYE).norm(dim=1)
        # Where the left edge of camera 1's view lies beyond the right edge of camera 0's, at most at 0.277 ahead.
        fog = (distance > 0.15) & (distance < 0.25)
        return torch.where(fog, -math.log(1 - alpha) / 0.1, wall(1.6)(points))

    optimiser = optimiser_of(images, formula, held_out=[2])
    optimiser.step_index, optimiser.switch = 39, 20  # sampled from a tenth of the distance on
    beside = APART / (2 * 1.6 * HALF)
    assert share(optimiser, 0) == pytest.approx(alpha + (1 - alpha) * beside, abs=0.04)


def test_an_empty_view_has_none(images):
    assert share(optimiser_of(images, lambda points: torch.zeros(len(points))), 0) == 0.0


def test_the_report_has_its_mean_over_held_out_views(images):
    optimiser = optimiser_of(images, wall(1.0), held_out=[2, 3])
    scores = list(score_views(optimiser.renderer, images, [2, 3]))
    assert share(optimiser, 2) != share(optimiser, 3)
    mean = (share(optimiser, 2) + share(optimiser, 3)) / 2
    found = held_out_report(optimiser.renderer, [2, 3], scores)
    assert found.unshared_opacity == pytest.approx(mean)
