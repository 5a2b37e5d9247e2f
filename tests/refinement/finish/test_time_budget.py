"""A run with a time budget takes as many steps as fit, and says so if even few do not."""

import math
import time

import pytest

from biresnerf.data.scene_kind import SceneKind
from biresnerf.data.workload import FIRST_ROUND, LEARNING
from biresnerf.forecast.run_forecast import RATES
from biresnerf.refinement.finish.work_ahead import budget_warnings, step_weights
from biresnerf.refinement.optimise.methods import BIRESNERF
from biresnerf.refinement.stages.checkpoint import load_checkpoint
from biresnerf.refinement.stages.two_stages import MEASURED_STEPS
from tests.refinement.tiny_scene import TinyRun, finished, given_scene, tiny_optimiser, tiny_options, tiny_set

STEPS = 400


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return tiny_set(tmp_path_factory.mktemp("scene"))


def begun(scene, folder, **changed):
    lengths = {"steps": STEPS, "coarse_steps_min": 100, "coarse_steps_max": 200, "verdict": False}
    options = tiny_options(**{**lengths, **changed})
    return TinyRun(tiny_optimiser(*scene, options), given_scene(*scene), folder)


def with_step_of(run, seconds):
    """As if steps of stage 1 took so long, and those of stage 2 twice as long; all else nothing."""
    weights = run.forecast.step_weights = step_weights(run.optimiser.options, kind=SceneKind())
    run.forecast.rates = dict.fromkeys(RATES, 0.0) | {
        "coarse step": seconds / weights["coarse"],
        "fine step": 2 * seconds / weights["fine"],
    }
    return run


def left_s(run):
    return run.forecast.left_s(run.ahead.left())


@pytest.mark.parametrize("seconds", [350.0, 450.0, 550.0])
def test_as_many_steps_are_taken_as_there_is_time_for(scene, tmp_path, seconds):
    run = with_step_of(begun(scene, tmp_path), 1.0)
    run.end_in(seconds)
    run.ahead.choose_steps(STEPS)
    assert BIRESNERF.finish.least_steps * STEPS < run.optimiser.schedule.steps < STEPS
    assert left_s(run) == pytest.approx(seconds, rel=0.02)
    options = run.optimiser.options
    assert options.coarse_steps_max == pytest.approx(options.steps / 2, abs=1)


def test_no_more_steps_are_taken_than_were_asked_for_and_no_fewer_than_a_tenth(scene, tmp_path):
    run = with_step_of(begun(scene, tmp_path), 1.0)
    run.end_in(1e6)
    run.ahead.choose_steps(STEPS)
    assert run.optimiser.schedule.steps == STEPS
    run.end_in(-1e6)
    run.ahead.choose_steps(STEPS)
    assert run.optimiser.schedule.steps == round(BIRESNERF.finish.least_steps * STEPS)


def test_steps_that_were_too_few_are_added_again_where_they_turn_out_faster(scene, tmp_path):
    run = with_step_of(begun(scene, tmp_path), 1.0)
    run.end_in(400)
    run.ahead.choose_steps(STEPS)
    few = run.optimiser.schedule.steps
    run.optimiser.start_reconstruction()
    with_step_of(run, 0.7).ahead.choose_steps(STEPS)
    assert few < run.optimiser.schedule.steps < STEPS


@pytest.mark.parametrize(
    ("seconds", "steps"), [(1e6, round((FIRST_ROUND + LEARNING) * STEPS)), (400.0, None)]
)
def test_time_that_an_adjustment_leaves_goes_to_the_field_at_the_poses_it_found(
    scene, tmp_path, seconds, steps
):
    run = with_step_of(begun(scene, tmp_path), 1.0)
    run.end_in(100)  # as far as was known before it
    run.ahead.choose_steps(STEPS)
    few = run.optimiser.schedule.steps
    run.optimiser.start_reconstruction()
    run.optimiser.poses_held = True
    run.state.note(adjusted=True)
    run.optimiser.end_after(LEARNING)
    assert run.optimiser.schedule.steps < few
    run.end_in(seconds)
    run.ahead.choose_steps(STEPS)
    found = run.optimiser.schedule.steps
    assert found > few
    if steps is None:
        assert left_s(run) == pytest.approx(seconds, rel=0.02)
    else:
        assert found == steps


@pytest.mark.slow
def test_a_run_is_planned_again_at_each_check_of_stage_2(scene, tmp_path):
    run = begun(scene, tmp_path, steps=120, coarse_steps_min=10, coarse_steps_max=20, check_every=10)
    planned = []
    run.state.keep_to(lambda: planned.append(run.optimiser.step_index))
    assert finished(run)
    switch = run.optimiser.switch
    due = {step for step in range(switch + 1, 121) if step % 10 == 0} | {
        MEASURED_STEPS,
        switch + MEASURED_STEPS,
    }
    assert set(planned) == due - ({MEASURED_STEPS} if switch < MEASURED_STEPS else set())


@pytest.mark.slow
def test_a_run_without_time_ends_early_and_says_what_it_took(scene, tmp_path):
    run = begun(scene, tmp_path, time_budget_s=0.01)
    run.ahead.keep_to_budget(time.monotonic(), STEPS)
    assert finished(run)
    assert MEASURED_STEPS <= run.optimiser.step_index == round(BIRESNERF.finish.least_steps * STEPS)
    (warning,) = budget_warnings(run.optimiser.options.time_budget_s, run.state.record.seconds)
    assert "of a budget of 0.01 s" in warning


def test_a_run_late_because_kernels_were_compiled_says_so():
    spent = {"preparing": 88.0, "compiling": 60.0, "coarse": 30.0, "fine": 49.0}
    (warning,) = budget_warnings(120.0, spent)
    assert "took 227 s of a budget of 120 s, 148 s of them before the first step" in warning
    assert "compiles kernels (60 s of waiting)" in warning
    del spent["compiling"]
    (warning,) = budget_warnings(120.0, spent)
    assert warning.endswith("Give it more time, or fewer or smaller photos.")


@pytest.mark.slow
def test_a_run_without_a_budget_takes_all_its_steps(scene, tmp_path):
    run = begun(scene, tmp_path, steps=60, coarse_steps_min=10, coarse_steps_max=20)
    run.ahead.keep_to_budget(time.monotonic(), 60)
    assert (run.state.ends, finished(run)) == (math.inf, True)
    assert run.optimiser.step_index == 60
    assert budget_warnings(run.optimiser.options.time_budget_s, run.state.record.seconds) == ()


def test_time_before_an_interruption_counts_against_the_budget(scene, tmp_path):
    run = begun(scene, tmp_path, time_budget_s=200.0)
    run.ahead.keep_to_budget(1000.0, STEPS)
    whole = run.state.ends
    run.state.record.seconds.update(preparing=20.0, coarse=30.0)
    run.ahead.keep_to_budget(1000.0, STEPS)
    assert run.state.ends == pytest.approx(whole - 50.0)


@pytest.mark.slow
def test_a_resumed_run_keeps_the_lengths_that_were_chosen(scene, tmp_path):
    run = begun(scene, tmp_path, time_budget_s=0.01)
    run.ahead.keep_to_budget(time.monotonic(), STEPS)
    assert finished(run)
    again = begun(scene, tmp_path, time_budget_s=0.01)
    again.stages.restore(load_checkpoint(tmp_path))
    assert again.optimiser.options == run.optimiser.options
    assert again.optimiser.schedule == run.optimiser.schedule
    assert again.stages.detector.cap == run.optimiser.options.coarse_steps_max < 200
