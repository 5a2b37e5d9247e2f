"""Outside of the field's kernels, a step never makes the host wait for a GPU. Shown without a GPU: `traced_step`."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from benchmarks.gpu.launches import traced_step
from biresnerf.geometry.rigid_bodies import RigidBodies
from biresnerf.refinement.numbers.scene import FrameNumbers
from biresnerf.refinement.optimise.joint_optimiser import JointOptimiser
from biresnerf.refinement.optimise.methods import Recipe
from biresnerf.refinement.parameters.intrinsics_parameters import lenses_of
from biresnerf.refinement.scene.scene_frame import scene_frame
from tests.refinement.tiny_scene import CPU, tiny_options, tiny_set

HELD_OUT = [3]
RIG = RigidBodies(np.arange(7) // 2, np.zeros(7, bool))  # every two cameras


@pytest.fixture(scope="module")
def tiny(tmp_path_factory):
    return tiny_set(tmp_path_factory.mktemp("tiny"))


def trained(tiny, *, stage: int = 1, bodies: RigidBodies | None = None, **options) -> JointOptimiser:
    """After three steps of a stage."""
    dataset, images = tiny
    frame = scene_frame(dataset.world_from_cam, images, FrameNumbers())
    start = frame.unit_from_world.apply_to_poses(dataset.world_from_cam)
    chosen = tiny_options(**options)
    lenses = lenses_of(dataset, images, chosen.refine_intrinsics, HELD_OUT, CPU)
    made = JointOptimiser(
        images, frame, start, Recipe.of(chosen, CPU, 2), HELD_OUT, bodies=bodies, lenses=lenses
    )
    if stage == 2:
        made.start_reconstruction()
    for _ in range(3):
        made.step()
    return made


@pytest.mark.parametrize(
    "what",
    [
        {},
        {"stage": 2},
        {"refine_intrinsics": "all"},
        {"exposure": "on"},
        {"bodies": RIG},
        {"method": "baa-ngp"},
    ],
    ids=lambda what: "-".join(what) or "stage 1",
)
@pytest.mark.parametrize("looks_at_cells", [False, True])
def test_a_step_needs_no_value_of_the_device_and_moves_none(tiny, what, looks_at_cells):
    trace = traced_step(trained(tiny, **what), looks_at_cells=looks_at_cells)
    assert trace.launches
    assert trace.crossings == []


def test_a_step_that_needs_a_value_of_the_device_is_refused(tiny):
    optimiser = trained(tiny)
    optimiser.exposure.shown = lambda rendering, image: rendering.colour * float(image.sum())
    with pytest.raises(RuntimeError, match="item"):
        traced_step(optimiser)


def test_a_step_that_copies_to_the_device_is_listed(tiny):
    optimiser = trained(tiny)
    optimiser.exposure.shown = lambda rendering, image: rendering.colour * torch.ones(3).to(image.device)
    assert len(traced_step(optimiser).crossings) == 1
