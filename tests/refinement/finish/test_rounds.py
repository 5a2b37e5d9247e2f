"""Stage 2 in two rounds: when cameras are held after the first adjustment, and when they go on with the field."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from biresnerf.data.workload import FIRST_ROUND, LEARNING
from biresnerf.refinement.finish import rounds
from biresnerf.refinement.finish.adjust_cameras import adjust_cameras
from biresnerf.refinement.finish.outcome import Finish
from biresnerf.refinement.finish.rounds import run_rounds
from biresnerf.refinement.lost.lost_cameras import LostCameraRepair
from biresnerf.refinement.stages.checkpoint import load_checkpoint
from tests.refinement.adjustment.rig import disturbed, observed
from tests.refinement.finish.test_adjust_cameras import begun, errors_deg, lenses
from tests.refinement.tiny_scene import TinyRun, tiny_optimiser, tiny_options

pytestmark = pytest.mark.slow


@pytest.fixture(name="rng")
def generator():
    return np.random.default_rng(2)


def test_the_field_learns_at_adjusted_poses_that_stand_still(tmp_path, rng):
    run, truth = begun(tmp_path, rng, given=lambda poses: disturbed(poses, rng, 0.1, 0.3))
    run.stages.run_stage_1()
    before = errors_deg(run, truth)
    ends = []
    step = run.optimiser.step

    def watched():
        ends.append(run.optimiser.poses.poses())
        return step()

    run.optimiser.step = watched
    finish = run_rounds(run.stages, run.scene)
    assert [each.name for each in finish.candidates if each.chosen] == ["adjusted-tracks"]
    steps = run.optimiser.options.steps
    assert run.optimiser.step_index == (FIRST_ROUND + LEARNING) * steps
    assert all(torch.equal(ends[-1], poses) for poses in ends[-round(LEARNING * steps) :])
    assert errors_deg(run, truth).mean() < 0.2 * before.mean()


def test_tracks_that_agree_on_other_poses_than_the_photos_are_not_believed(tmp_path, rng):
    """As of a symmetric thing: all tracks fit poses that are far from the truth."""
    run, truth = begun(tmp_path, rng, refined=0.003)
    run.stages.run_stage_1()
    folded = disturbed(truth, rng, 0.1, 0.3)
    tracks = observed(folded, rng.uniform(-0.5, 0.5, (120, 3)), lenses(run.scene.dataset), rng, 0.02)
    run.scene = replace(run.scene, tracks=tracks)
    run.stages.repair = LostCameraRepair(run.optimiser, None)
    # So many as tell poses apart in photos of that size.
    run.optimiser.options = run.optimiser.options.model_copy(update={"trial_steps": 60})
    before = errors_deg(run, truth)
    finish = run_rounds(run.stages, run.scene)
    assert [each.name for each in finish.candidates if each.chosen] == ["refined"]
    assert run.optimiser.step_index == run.optimiser.options.steps
    assert not run.optimiser.poses_held
    assert run.optimiser.lenses.certainty == (None,)
    assert finish.fit is None
    assert errors_deg(run, truth).mean() < 2 * before.mean() + 0.5


def test_poses_go_on_with_the_field_to_the_last_step_where_no_evidence_tells(tmp_path, rng):
    run, _ = begun(tmp_path, rng)
    run.scene = replace(run.scene, tracks=None)
    run.stages.run_stage_1()
    assert run_rounds(run.stages, run.scene).candidates == ()
    assert run.optimiser.step_index == run.optimiser.options.steps
    assert not run.optimiser.poses_held


def test_a_run_resumed_after_the_first_adjustment_ends_and_reports_as_an_uninterrupted_one(tmp_path, rng):
    run, _ = begun(tmp_path / "once", rng, given=lambda poses: disturbed(poses, rng, 0.1, 0.3))
    run.stages.run_stage_1()
    whole = run_rounds(run.stages, run.scene)
    again = TinyRun(
        tiny_optimiser(run.scene.dataset, run.scene.images, tiny_options()), run.scene, run.folder
    )
    again.stages.restore(load_checkpoint(run.folder))
    assert again.optimiser.schedule.steps == run.optimiser.step_index
    resumed = run_rounds(again.stages, again.scene)
    torch.testing.assert_close(again.optimiser.poses.poses(), run.optimiser.poses.poses())
    assert [each.name for each in whole.candidates if each.chosen] == ["adjusted-tracks"]
    assert resumed.candidates == whole.candidates
    assert again.state.record.model_copy(update={"resumed": 0, "seconds": {}}) == run.state.record.model_copy(
        update={"seconds": {}}
    )
    # The evidence is gathered once more, with the surface of a field that has learned on.
    (once,), (anew,) = (each.optimiser.lenses.certainty for each in (run, again))
    assert anew == replace(once, deviation=pytest.approx(once.deviation, rel=0.01))


@pytest.mark.parametrize("believed", [True, False])
def test_a_run_resumed_without_time_to_adjust_again_reports_what_the_first_adjustment_found(
    tmp_path, rng, believed
):
    run, _ = begun(tmp_path, rng, given=lambda poses: disturbed(poses, rng, 0.1, 0.3))
    run.stages.run_stage_1()
    run.end_in(-1.0)
    first = run_rounds(run.stages, run.scene)
    assert first.fit is not None
    again = TinyRun(
        tiny_optimiser(run.scene.dataset, run.scene.images, tiny_options()), run.scene, run.folder
    )
    again.stages.restore(load_checkpoint(run.folder))
    again.state.note(believed=believed)
    again.end_in(-1.0)
    resumed = run_rounds(again.stages, again.scene)
    assert resumed.candidates == first.candidates
    assert (resumed.fit is not None) is believed
    torch.testing.assert_close(again.optimiser.poses.poses(), run.optimiser.poses.poses())


@pytest.mark.parametrize(("seconds", "adjusted"), [(np.inf, 2), (-1.0, 1)])
def test_cameras_are_adjusted_again_only_where_there_is_time(tmp_path, rng, monkeypatch, seconds, adjusted):
    """The first adjustment finds nothing better, so that the field's poses would be adjusted once more."""
    run, _ = begun(tmp_path, rng, refined=0.0, noise_px=0.3)
    run.stages.run_stage_1()
    run.end_in(seconds)
    calls = []
    monkeypatch.setattr(
        rounds, "adjust_cameras", lambda *run, **how: calls.append(run) or adjust_cameras(*run, **how)
    )
    run_rounds(run.stages, run.scene)
    assert run.optimiser.step_index == run.optimiser.options.steps
    assert len(calls) == adjusted


def test_cameras_that_the_first_adjustment_moved_are_not_adjusted_again(tmp_path, rng, monkeypatch):
    run, _ = begun(tmp_path, rng, given=lambda poses: disturbed(poses, rng, 0.1, 0.3))
    run.stages.run_stage_1()
    found = []
    monkeypatch.setattr(
        rounds, "adjust_cameras", lambda *run, **how: found.append(adjust_cameras(*run, **how)) or found[-1]
    )
    assert run_rounds(run.stages, run.scene) is found[0]
    assert len(found) == 1
    assert found[0].moved


@pytest.mark.parametrize(
    ("budget_s", "late_s", "again"), [(1000, 10, True), (1000, 60, False), (0, 10, False)]
)
def test_an_adjustment_that_was_planned_for_is_not_left_out_for_a_moment(
    tmp_path, rng, monkeypatch, budget_s, late_s, again
):
    """Steps are chosen so that what follows them just ends in time; they may take a little longer than that."""
    run, _ = begun(tmp_path, rng)
    run.optimiser.options = run.optimiser.options.model_copy(update={"time_budget_s": budget_s})
    adjustments: list[float] = []

    def refused(*_run, **_how):
        adjustments.append(run.optimiser.step_index)
        run.end_in(100 - late_s)
        return Finish()

    monkeypatch.setattr(rounds, "adjust_cameras", refused)
    monkeypatch.setattr(run.forecast, "seconds", lambda phase: 100.0 if phase == "adjusting" else 0.0)
    run.stages.run_stage_1()
    run_rounds(run.stages, run.scene)
    assert len(adjustments) == 1 + again
