"""Schedules: what is continuous, what opens in which order, what stands still."""

from __future__ import annotations

import numpy as np
import pytest

from biresnerf.options.presets import PRESETS
from biresnerf.options.refine_options import RefineOptions
from biresnerf.refinement.optimise.schedule import Schedule, smooth_ramp

SMALL_JUMP = 0.15  # of the largest value; the shortest ramp takes 15 steps


@pytest.fixture(scope="module", params=list(PRESETS))
def schedule(request):
    return Schedule(RefineOptions(preset=request.param).resolved("cpu"), pixel=0.0125)


def switch_of(schedule: Schedule) -> int:
    return (int(schedule.options.coarse_steps_min) + int(schedule.options.coarse_steps_max)) // 2


def largest_jump(values) -> float:
    values = np.asarray(values)
    return float(np.abs(np.diff(values, axis=0)).max() / max(np.abs(values).max(), 1e-12))


def test_a_shorter_run_shortens_its_stages_but_not_what_it_is_judged_by():
    def of(steps):
        options = RefineOptions(preset="fast", steps=steps).resolved("cpu")
        return options.coarse_steps_max, options.trial_steps

    full = PRESETS["fast"]
    assert of(full["steps"]) == (full["coarse_steps_max"], full["trial_steps"])
    assert of(full["steps"] // 2) == (full["coarse_steps_max"] // 2, full["trial_steps"])
    assert of(400) == (round(full["coarse_steps_max"] * 400 / full["steps"]), 100)


def test_the_smooth_ramp_is_flat_at_both_ends_and_half_in_the_middle():
    assert [smooth_ramp(q) for q in (-1, 0, 1, 2)] == pytest.approx([0, 0, 1, 1])
    assert smooth_ramp(0.5) == pytest.approx(0.5)
    assert smooth_ramp(0.25) == pytest.approx(0.5 * (1 - np.sqrt(0.5)))
    assert smooth_ramp(1e-3) < 1e-5
    assert smooth_ramp(1 - 1e-3) > 1 - 1e-5


def test_lenses_stand_still_until_poses_have_explained_what_they_can(schedule):
    start = schedule.numbers.lens_start * schedule.options.coarse_steps_min
    assert start > 1
    assert all(schedule.lens_rate(step, None) == 0.0 for step in range(int(start) + 1))
    assert schedule.lens_rate(int(1.5 * start), None) > 0.0


def test_everything_within_stage_1_changes_little_from_step_to_step(schedule):
    steps = range(int(schedule.options.coarse_steps_max))
    for values in (
        [schedule.interval(t, None) for t in steps],
        [schedule.near(t, None) for t in steps],
        [schedule.samples(t, None) for t in steps],
        [schedule.pose_rate(t, None) for t in steps],
        [schedule.field_rates(t, None).networks for t in steps],
        [schedule.field_rates(t, None).pose for t in steps],
    ):
        assert largest_jump(values) < SMALL_JUMP


@pytest.mark.slow
def test_everything_within_stage_2_changes_little_from_step_to_step_until_poses_freeze(schedule):
    switch = switch_of(schedule)
    steps = range(switch, int(schedule.numbers.freeze_share * schedule.steps) - 1)
    for values in (
        [schedule.pose_rate(t, switch) for t in steps],
        [schedule.field_rates(t, switch).networks for t in steps],
        [schedule.field_rates(t, switch).reconstruction for t in steps],
        [schedule.field_rates(t, switch).reconstruction_columns for t in steps],
        [schedule.position_gradient(t, switch).reconstruction_share for t in steps],
        [schedule.position_gradient(t, switch).reconstruction_smoothing for t in steps],
    ):
        assert largest_jump(values) < SMALL_JUMP


def test_sampling_and_targets_get_finer_and_end_fine(schedule):
    end, switch = int(schedule.options.coarse_steps_max), switch_of(schedule)
    steps = np.linspace(0, end, 60).astype(int)
    for values in (
        [schedule.interval(t, None) for t in steps],
        [schedule.near(t, None) for t in steps],
        [schedule.blur(t, None, 200) for t in steps],
    ):
        assert all(np.diff(values) <= 1e-12)
        assert values[0] > values[-1]
    assert schedule.interval(end, None) == pytest.approx(schedule.fine_interval)
    assert schedule.interval(switch, switch) == schedule.fine_interval
    assert schedule.blur(0, None, 200) > 1
    assert schedule.blur(end, None, 200) == schedule.blur(switch, switch, 200) == 0
    assert (
        schedule.samples(end, None) == schedule.samples(switch, switch) == schedule.options.samples_per_step
    )


def test_poses_stand_still_when_frozen_and_not_before(schedule):
    switch, last = switch_of(schedule), schedule.steps - 1
    assert schedule.pose_rate(last, switch) == schedule.pose_rate(last, None) == 0.0
    frozen = [t for t in range(switch, schedule.steps) if schedule.pose_rate(t, switch) == 0.0]
    assert frozen == list(range(frozen[0], schedule.steps))
    assert 0 < len(frozen) < 0.2 * schedule.steps


def test_rates_start_at_zero_and_rise(schedule):
    assert schedule.pose_rate(0, None) == 0.0
    assert schedule.field_rates(0, None).networks == 0.0
    assert 0 < schedule.pose_rate(2, None) < schedule.pose_rate(5, None)


def test_the_switch_dips_the_rates_of_what_has_been_learnt_and_gives_them_back(schedule):
    switch, warmup = switch_of(schedule), int(schedule.options.warmup_steps)
    before, at = schedule.pose_rate(switch - 1, None), schedule.pose_rate(switch, switch)
    assert 0 < at < 0.5 * before
    assert schedule.pose_rate(switch + 2 * warmup, switch) > 2 * at
    networks = [schedule.field_rates(t, switch).networks for t in (switch, switch + warmup)]
    assert networks[0] < schedule.field_rates(switch - 1, None).networks
    assert networks[1] == pytest.approx(schedule.field_rates(switch + warmup, None).networks)


def first_open(rates) -> list[int]:
    return list(np.argmax(np.asarray(rates) > 0, axis=0))


def test_levels_of_the_reconstruction_module_open_coarsest_first_and_all_by_the_end_of_the_warm_up(schedule):
    switch, warmup = switch_of(schedule), int(schedule.options.warmup_steps)
    rates = [schedule.field_rates(t, switch).reconstruction for t in range(switch, switch + warmup + 1)]
    assert len(rates[0]) == schedule.options.reconstruction_levels
    opened = first_open(rates)
    assert opened == sorted(opened)
    assert opened[0] < opened[-1]
    assert rates[0][-1] == 0.0
    assert rates[-1] == pytest.approx([rates[-1][0]] * len(rates[-1]))  # all fully open
    for row in rates:
        assert all(np.diff(row) <= 1e-15)  # never a fine level before a coarse one


def test_in_stage_1_the_reconstruction_module_does_not_learn(schedule):
    rates = schedule.field_rates(100, None)
    assert rates.reconstruction == ()
    assert rates.reconstruction_columns == 0.0


def test_the_reconstruction_module_moves_no_pose_before_it_has_warmed_up(schedule):
    switch, warmup = switch_of(schedule), int(schedule.options.warmup_steps)
    assert schedule.position_gradient(switch, switch).reconstruction_share == 0.0
    assert schedule.position_gradient(switch + warmup // 2, switch).reconstruction_share == 0.0
    assert schedule.position_gradient(switch + 3 * warmup, switch).reconstruction_share == 1.0
    assert schedule.position_gradient(schedule.steps, switch).reconstruction_smoothing == pytest.approx(0.0)


def test_poses_of_an_open_scene_wait_until_the_field_has_formed(schedule):
    waiting = Schedule(schedule.options, schedule.pixel, unbounded=True)
    early = int(schedule.options.coarse_steps_min) // 20
    assert waiting.pose_rate(early, None) < 0.1 * schedule.pose_rate(early, None)
    late = int(schedule.options.coarse_steps_min)
    assert waiting.pose_rate(late, None) == schedule.pose_rate(late, None)
