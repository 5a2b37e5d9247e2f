"""Batches that do not fit in a GPU's memory: the run goes on with smaller ones and says so."""

from __future__ import annotations

import pytest
import torch

from biresnerf.geometry.pose_error import pose_error
from biresnerf.refinement.optimise.device_memory import smaller_batches, step_that_fits
from biresnerf.refinement.optimise.joint_optimiser import JointOptimiser
from tests.refinement.tiny_scene import TinyRun, finished, given_scene, tiny_optimiser, tiny_options, tiny_set

OPTIONS = tiny_options(samples_per_step=1 << 16)


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return tiny_set(tmp_path_factory.mktemp("scene"))


@pytest.fixture
def optimiser(scene) -> JointOptimiser:
    return tiny_optimiser(*scene, OPTIONS, held_out=[3])


def limit_memory(optimiser: JointOptimiser, rays: int) -> list[int]:
    """Let no batch of more than so many rays through; the rays of those that went through."""
    render, through = optimiser.field.render, []

    def with_little_memory(batch, *others):
        if torch.is_grad_enabled() and len(batch.origin) > rays:
            raise torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 2.00 GiB.")
        if torch.is_grad_enabled():
            through.append(len(batch.origin))
        return render(batch, *others)

    optimiser.field.render = with_little_memory  # type: ignore[method-assign]
    return through


@pytest.mark.slow
def test_a_run_without_enough_memory_ends_with_smaller_batches_and_says_so(scene, optimiser, tmp_path):
    through = limit_memory(optimiser, rays=400)
    run = TinyRun(optimiser, given_scene(*scene, held_out=[3]), tmp_path)
    assert finished(run)
    assert len(through) == optimiser.schedule.steps
    assert max(through) <= 400
    assert optimiser.batch_share < 1
    assert pose_error(optimiser.poses.poses().numpy(), scene[0].world_from_cam).aligned.rotation_deg.mean < 5
    warnings = run.report().warnings
    assert any("GPU's memory is too small" in warning for warning in warnings)


def test_a_run_with_enough_memory_says_nothing(optimiser):
    step_that_fits(optimiser)
    assert optimiser.batch_share == 1
    assert smaller_batches(optimiser.batch_share, 4096) == ()


def test_what_does_not_fit_in_any_size_is_an_error(optimiser):
    limit_memory(optimiser, rays=0)
    with pytest.raises(torch.OutOfMemoryError):
        step_that_fits(optimiser)
    assert optimiser.step_index == 0


def test_a_run_that_goes_on_elsewhere_keeps_its_smaller_batches(scene, optimiser):
    limit_memory(optimiser, rays=400)
    step_that_fits(optimiser)
    other = tiny_optimiser(*scene, OPTIONS, held_out=[3])
    other.load_state(optimiser.state(), optimiser.step_state())
    assert other.batch_share == optimiser.batch_share < 1
