"""Schedules of the published methods against their sources' numbers, and the double pose step."""

from __future__ import annotations

import pytest
import torch

from biresnerf.options.refine_options import RefineOptions
from biresnerf.refinement.optimise.methods import find_method
from biresnerf.refinement.optimise.schedule import Schedule
from biresnerf.refinement.parameters.pose_parameters import PoseParameters

pytestmark = pytest.mark.slow

DISTANCE = 4.0
ONE_STAGE = ("baa-ngp", "nerfacc-barf", "barf")


def schedule(method: str, *, unbounded: bool = False, steps: int | None = None) -> Schedule:
    options = RefineOptions(preset="paper", method=method, steps=steps).resolved("cpu")
    return find_method(method).schedule(options, 0.005, unbounded, DISTANCE)


@pytest.mark.parametrize(
    ("method", "field_first", "field_last"),
    [("baa-ngp", 1e-2, 1e-4), ("nerfacc-barf", 5e-4, 1e-4), ("barf", 5e-4, 1e-4)],
)
def test_rates_decay_exponentially_from_the_first_step_to_the_last(method, field_first, field_last):
    for steps in (None, 500):  # a short run goes the same way
        s = schedule(method, steps=steps)
        for share in (0.0, 0.25, 0.5, 1.0):
            t = round(share * s.steps)
            assert s.pose_rate(t, 0) == pytest.approx(1e-3 * 1e-2**share)
            assert s.field_rates(t, 0).networks == pytest.approx(
                field_first * (field_last / field_first) ** share
            )


@pytest.mark.parametrize("method", [*ONE_STAGE, "biresnerf-paper"])
def test_nothing_of_ours_is_added(method):
    s = schedule(method)
    assert s.blur(0, None, 400.0) == 0.0
    assert s.pruned(0)
    assert not s.dilated(None)
    assert s.pose_rate(s.steps - 1, 100) > 0  # poses move to the end
    gradient = s.position_gradient(0, None)
    assert (gradient.pose_smoothing, gradient.reconstruction_smoothing) == (0.0, 0.0)


def test_barf_samples_depths_2_to_6_of_cameras_4_away_and_its_nerfacc_version_every_3_hundredths():
    s = schedule("barf")
    assert (s.near(0, 0) * DISTANCE, s.far(20.0)) == (2.0, 6.0)
    assert schedule("nerfacc-barf").fine_interval == pytest.approx(0.03)
    assert schedule("barf", unbounded=True).far(60.0) == 60.0


def test_all_cells_are_looked_at_for_the_first_256_steps_of_the_published_length():
    for method in ("baa-ngp", "nerfacc-barf", "biresnerf-paper"):
        s = schedule(method)
        assert s.empty_cells_looked_at(255) == 1
        assert s.empty_cells_looked_at(257) == 0.25


def test_the_papers_reconstruction_module_warms_up_smoothly_from_nothing_at_the_switch():
    s, switch = schedule("biresnerf-paper"), 9000
    warmup = int(s.options.warmup_steps)
    rates = [s.field_rates(switch + t, switch) for t in range(warmup + 1)]
    assert rates[0].reconstruction_columns < 1e-4 * rates[-1].reconstruction_columns
    assert rates[-1].reconstruction_columns == pytest.approx(1e-2, rel=0.2)
    assert all(len(set(r.reconstruction)) == 1 for r in rates)  # all levels alike
    assert rates[0].networks == pytest.approx(s.field_rates(switch, None).networks)
    assert s.pose_rate(switch, switch) < 0.1 * s.pose_rate(switch - 1, None)
    assert s.pose_rate(switch + warmup, switch) == pytest.approx(s.pose_rate(switch + warmup, None))


def test_the_double_step_moves_poses_by_both_rates_and_is_restored_with_both_moments():
    def step(poses: PoseParameters) -> None:
        (poses.matrices()[:, :, 3] * torch.tensor([1.0, -2.0, 3.0])).sum().backward()
        poses.step(1e-3, field_rate=1e-2)

    start = torch.eye(4).repeat(2, 1, 1)
    first = PoseParameters(start, 1.0, torch.device("cpu"), double_step=True)
    step(first)
    torch.testing.assert_close(
        first.translation.detach(), torch.tensor([[-1.0, 1.0, -1.0]] * 2) * 1.1e-2, rtol=1e-3, atol=0
    )
    saved = {name: tensor.clone() for name, tensor in first.state().items()}
    step(first)
    second = PoseParameters(start, 1.0, torch.device("cpu"), double_step=True)
    second.load_state(saved)
    step(second)
    assert torch.equal(first.matrices(), second.matrices())
    single = PoseParameters(start, 1.0, torch.device("cpu"))
    step(single)
    assert float(single.translation.detach().abs().max()) == pytest.approx(1e-3, rel=1e-3)
