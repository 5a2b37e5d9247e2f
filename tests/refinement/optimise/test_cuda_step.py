"""The joint step on a GPU: nothing in it waits for the device, and it learns."""

from __future__ import annotations

import pytest
import torch

from biresnerf.refinement.numbers.scene import FrameNumbers
from biresnerf.refinement.optimise.joint_optimiser import JointOptimiser
from biresnerf.refinement.optimise.methods import Recipe
from biresnerf.refinement.scene.scene_frame import scene_frame
from tests.refinement.tiny_scene import tiny_options, tiny_set


@pytest.mark.skipif(
    not torch.cuda.is_available(), reason="the joint step on CUDA needs a GPU; torch finds none"
)
def test_a_step_waits_for_nothing_and_the_error_falls(tmp_path):
    dataset, images = tiny_set(tmp_path)
    frame = scene_frame(dataset.world_from_cam, images, FrameNumbers())
    start = frame.unit_from_world.apply_to_poses(dataset.world_from_cam)
    options = tiny_options(device="cuda", steps=400, coarse_steps_max=200)
    optimiser = JointOptimiser(images, frame, start, Recipe.of(options, torch.device("cuda"), 1), [1])
    first = [optimiser.step().mean_squared_error for _ in range(18)]
    rays = optimiser.rays  # steps of other numbers of rays have graphs of their own, to be recorded first
    for _ in range(4):
        optimiser.rays = rays
        optimiser.step()
    torch.cuda.set_sync_debug_mode("error")
    try:
        for _ in range(20):  # one update of the occupancy grid among them
            optimiser.rays = rays
            optimiser.step()
    finally:
        torch.cuda.set_sync_debug_mode("default")
    last = [optimiser.step().mean_squared_error for _ in range(60)]
    assert sum(last[-10:]) / 10 < sum(first[:5]) / 5
