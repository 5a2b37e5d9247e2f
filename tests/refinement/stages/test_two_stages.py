"""Both stages as one run: switching, stopping, resuming bit for bit."""

from __future__ import annotations

import pytest
import torch

from biresnerf.data.show.history import HISTORY, read_history
from biresnerf.errors import RefinementError
from biresnerf.progress import Monitor, Progress
from biresnerf.refinement.stages.checkpoint import load_checkpoint
from biresnerf.stages import CHECKPOINT
from tests.refinement.tiny_scene import TinyRun, finished, given_scene, tiny_optimiser, tiny_options, tiny_set

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return tiny_set(tmp_path_factory.mktemp("scene"))


def start(scene, folder, options, stop_at: int | None = None, told: list[Progress] | None = None) -> TinyRun:
    optimiser = tiny_optimiser(*scene, options, held_out=[3])
    return TinyRun(
        optimiser,
        given_scene(*scene, held_out=[3]),
        folder,
        Monitor(
            (told if told is not None else []).append,
            lambda: stop_at is not None and optimiser.step_index >= stop_at,
        ),
    )


@pytest.fixture(scope="module")
def whole(scene, tmp_path_factory):
    """A run without interruption."""
    run = start(scene, tmp_path_factory.mktemp("whole"), tiny_options())
    assert finished(run)
    return run


def curve(run: TinyRun) -> list[dict[str, float | str]]:
    lines = read_history(run.state.history.path)
    return [{key: value for key, value in line.items() if key != "seconds"} for line in lines]


@pytest.mark.parametrize("stop_at", [0, 13, 31])
def test_a_run_stopped_anywhere_and_resumed_ends_bit_for_bit_as_an_uninterrupted_one(
    scene, tmp_path, whole, stop_at
):
    stopped = start(scene, tmp_path, tiny_options(), stop_at)
    assert not finished(stopped)
    assert stopped.optimiser.step_index == stop_at
    resumed = start(scene, tmp_path, tiny_options())
    resumed.stages.restore(load_checkpoint(tmp_path))
    assert finished(resumed)
    assert resumed.state.record.resumed == 1
    assert resumed.optimiser.switch == whole.optimiser.switch
    assert torch.equal(resumed.optimiser.poses.poses(), whole.optimiser.poses.poses())
    for name, tensor in whole.optimiser.state().items():
        assert torch.equal(resumed.optimiser.state()[name], tensor), name
    assert resumed.stages.detector == whole.stages.detector
    assert curve(resumed) == curve(whole)


def test_stage_2_begins_at_the_cap_at_the_latest(whole):
    assert whole.optimiser.switch == 20
    assert whole.state.record.switch_reason == "cap"


def test_stage_2_begins_at_the_cap_though_no_check_falls_on_it(scene, tmp_path):
    run = start(scene, tmp_path, tiny_options(check_every=50, coarse_steps_max=17, steps=20))
    assert finished(run)
    assert run.optimiser.switch == 17


def test_progress_carries_what_the_detector_saw_last_and_in_stage_2_nothing_of_it(scene, tmp_path):
    told: list[Progress] = []
    assert not finished(start(scene, tmp_path, tiny_options(), 13, told))
    line = read_history(tmp_path / HISTORY)[-1]
    assert line["step"] == 10
    assert told[-1].metrics["confirmed"] == line["confirmed"]
    resumed = start(scene, tmp_path, tiny_options(), told=told)
    resumed.stages.restore(load_checkpoint(tmp_path))
    assert finished(resumed)
    assert told[-1].stage == "fine"
    assert "confirmed" not in told[-1].metrics


def test_a_stable_error_begins_stage_2_before_the_cap(scene, tmp_path):
    options = tiny_options(steps=30, coarse_steps_min=12, coarse_steps_max=30)
    run = start(scene, tmp_path, options, stop_at=16)
    run.stages.detector.decibels = [8.0] + [20.0] * 19
    check = run.stages.detector.check

    def flat(step: int, _):
        return check(step, 0.01)

    run.stages.detector.check = flat
    finished(run)
    assert run.state.record.switch_reason == "stable"
    assert run.optimiser.switch == 15  # the first check at or after the floor


def test_fractions_never_fall_and_checkpoints_are_told_when_they_exist(scene, tmp_path):
    told: list[Progress] = []
    run = start(scene, tmp_path, tiny_options().model_copy(update={"checkpoint_every_s": 0.01}), told=told)
    run.forecast.left["judging"] = 1e6
    assert finished(run)
    fractions = [progress.fraction for progress in told]
    assert fractions == sorted(fractions)
    assert fractions[-1] < 0.9
    assert {progress.checkpoint for progress in told} >= {CHECKPOINT.as_posix()}
    assert (told[-1].step, told[-1].steps_total) == (40, 40)
    assert {progress.stage for progress in told} == {"coarse", "fine"}
    assert next(p.step for p in told if p.stage == "fine") >= run.optimiser.switch


def test_the_fraction_waits_where_an_early_switch_makes_the_rest_dearer_than_thought(scene, tmp_path):
    told: list[Progress] = []
    run = start(scene, tmp_path, tiny_options(), told=told)
    run.optimiser.step_index = 12
    run.forecast.continues(12.0)
    run.forecast.rates["coarse step"] = run.forecast.rates["fine step"] = 1.0
    run.state.report(run.stages._progress(None))
    assert 0.1 < told[0].fraction < 0.9
    run.optimiser.start_reconstruction()
    run.forecast.rates["fine step"] = 10.0
    run.state.report(run.stages._progress(None))
    assert told[1].eta_s > told[0].eta_s
    assert told[1].fraction == told[0].fraction


def test_a_loss_that_is_nan_ends_the_run_with_a_reason(scene, tmp_path):
    run = start(scene, tmp_path, tiny_options())
    with torch.no_grad():
        run.optimiser.field.networks[4][:] = float("nan")
    with pytest.raises(RefinementError) as caught:
        finished(run)
    assert caught.value.code == "diverged"
    assert "step 1" in str(caught.value)


@pytest.mark.parametrize("wrong", [float("nan"), float("inf")])
def test_a_pose_that_is_not_finite_ends_the_run_with_a_reason(scene, tmp_path, wrong):
    run = start(scene, tmp_path, tiny_options())
    with torch.no_grad():
        run.optimiser.poses.translation[0, 1] = wrong
    with pytest.raises(RefinementError) as caught:
        finished(run)
    assert caught.value.code == "diverged"
