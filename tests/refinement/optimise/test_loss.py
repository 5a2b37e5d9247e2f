"""One loss per method, for all its cameras and for the repair of lost ones."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch.nn.functional import mse_loss, smooth_l1_loss

from biresnerf.refinement.lost.lost_cameras import LostCameraRepair
from biresnerf.refinement.optimise.methods import half_squared_error, squared_error
from tests.refinement.tiny_scene import tiny_optimiser, tiny_options, tiny_set


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return tiny_set(tmp_path_factory.mktemp("scene"))


class CountedLoss:
    """The squared error, and how often it was asked for."""

    def __init__(self) -> None:
        self.calls = 0

    def __call__(self, colour, target):
        self.calls += 1
        return squared_error(colour, target)


def test_losses_are_those_of_the_publications():
    colour, target = torch.rand(2, 50, 3, generator=torch.Generator().manual_seed(1))
    torch.testing.assert_close(half_squared_error(colour, target).mean(), smooth_l1_loss(colour, target))
    torch.testing.assert_close(squared_error(colour, target).mean(), mse_loss(colour, target))


def test_weighted_cameras_are_compared_by_the_methods_own_loss(scene):
    losses = []
    for weights in (None, torch.ones(7)):
        optimiser = tiny_optimiser(*scene, tiny_options())
        optimiser.method = replace(optimiser.method, loss=CountedLoss())
        optimiser.camera_errors.weights = weights
        losses.append(optimiser.step().loss)
        assert optimiser.method.loss.calls == 1
    assert losses[1] == pytest.approx(losses[0], rel=1e-6)


def test_repair_moves_cameras_by_the_methods_own_loss(scene):
    optimiser = tiny_optimiser(*scene, tiny_options())
    for _ in range(20):
        optimiser.step()
    enough = replace(optimiser.method.lost, run_share=10.0, event_share=10.0)
    optimiser.method = replace(optimiser.method, loss=CountedLoss(), lost=enough)
    optimiser.camera_errors.doubted[3] = True
    LostCameraRepair(optimiser).run()
    assert optimiser.method.loss.calls >= 40
