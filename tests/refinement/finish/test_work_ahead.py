"""A run's remaining work follows from the set, the options, and its progress."""

from dataclasses import replace

import numpy as np
import pytest

from biresnerf.data.points.tracks import Tracks
from biresnerf.data.scene_kind import SceneKind
from biresnerf.data.seeding import map_images
from biresnerf.data.workload import (
    ADJUSTMENT,
    FIRST_ROUND,
    JUDGING,
    LEARNING,
    Workload,
    adjustment_work,
    step_weights,
    workload,
)
from biresnerf.forecast.run_forecast import Forecast
from biresnerf.geometry.perturb import perturb_poses
from biresnerf.geometry.similarity import Similarity
from biresnerf.options.refine_options import RefineOptions
from biresnerf.refinement.finish.work_ahead import expect_run
from tests.refinement.tiny_scene import (
    TinyRun,
    given_scene,
    tiny_optimiser,
    tiny_options,
    tiny_recipe,
    tiny_run,
    tiny_set,
)

TRACKS = Tracks.of(np.array([0, 0]), np.array([0, 1]), np.ones((2, 2)))


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return tiny_set(tmp_path_factory.mktemp("scene"))


@pytest.fixture
def run_of(scene, tmp_path):
    def make(tracks=None, **options) -> TinyRun:
        dataset, images = scene
        optimiser = tiny_optimiser(dataset, images, tiny_options(**options))
        run = TinyRun(optimiser, replace(given_scene(dataset, images), tracks=tracks), tmp_path)
        run.ahead.expect_all()
        return run

    return make


def test_with_tracks_fewer_steps_are_taken_and_adjusted_cameras_are_checked(run_of):
    short, long = run_of(), run_of(TRACKS)
    assert (short.forecast.share, long.forecast.share) == (1.0, FIRST_ROUND + LEARNING)
    weight = step_weights(short.optimiser.options, kind=SceneKind())["fine"]
    assert short.forecast.left["fine"] == pytest.approx(20 * weight)
    assert long.forecast.left["fine"] == pytest.approx(10 * weight)
    assert short.forecast.left["checking"] == 0 < long.forecast.left["checking"]


@pytest.mark.parametrize(("tracks", "expected"), [(TRACKS, 1), (None, 2)])
def test_a_second_adjustment_is_expected_only_without_matches_or_where_the_first_moved_nothing(
    run_of, tracks, expected
):
    run = run_of(tracks)
    before = run.ahead.left()
    run.state.note(adjusted=True)
    after = run.ahead.left()
    assert after["adjusting"] == before["adjusting"] / expected > 0
    assert after["checking"] == 0
    run.state.note(adjusts_again=False)
    assert run.ahead.left()["adjusting"] == 0


@pytest.mark.parametrize(("off", "asked"), [(0.0, False), (0.1, True)])
def test_photos_are_expected_to_judge_only_cameras_that_matches_would_move_visibly(run_of, off, asked):
    run = run_of(TRACKS)
    present = run.optimiser.poses.poses().numpy()
    moved = perturb_poses(present, off, seed=1) if off else present
    # In another frame and scale than the run's own, as the user's are.
    turned = Similarity(
        2.0, np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]), np.array([1.0, 2.0, 3.0])
    ).apply_to_poses(moved)
    run.scene = replace(run.scene, start=replace(run.scene.start, matched_poses=turned))
    assert (run.ahead.left()["checking"] > 0) == asked
    run.ahead.expect()
    assert (run.forecast.left["checking"] > 0) == asked


def test_the_verdict_takes_time_only_where_it_is_asked_for(run_of):
    assert run_of(verdict=False).ahead.left()["judging"] == 0
    few, many = (run_of(trial_steps=steps).ahead.left()["judging"] - JUDGING for steps in (50, 100))
    assert many > 0
    assert many == pytest.approx(2 * few)


def test_many_cameras_take_more_than_in_proportion():
    few, many = (adjustment_work(count, 0) - ADJUSTMENT for count in (1000, 3000))
    assert few > ADJUSTMENT
    assert 4 < many / few < 6
    assert adjustment_work(100, 40_000) < 1.2 * (ADJUSTMENT + 40)


def test_methods_of_others_do_not_adjust(run_of):
    assert run_of(method="biresnerf-paper").ahead.left()["adjusting"] == 0


def test_a_run_from_given_poses_is_known_before_its_first_step(scene, run_of):
    found = Forecast()
    expect_run(found, scene[0], tiny_run(), tiny_recipe(start="given"))
    assert found.left == pytest.approx(run_of(start="given").forecast.left)


def test_matching_is_expected_where_poses_are_compared_with_matches(scene):
    pytest.importorskip("pycolmap")
    found = Forecast()
    expect_run(found, scene[0], tiny_run(), tiny_recipe(start="auto"))
    assert all(found.left[phase] > 0 for phase in ("features", "matching", "mapping", "trying"))
    assert found.left["checking"] == 0, "matches mostly start the run"


def matched_work(dataset, asked) -> Workload:
    return workload(dataset, asked, asked.resolved("cpu"), kind=SceneKind(), adjusts=True)


def test_half_the_steps_are_expected_where_matches_will_settle_poses_and_no_length_was_asked_for(scene):
    pytest.importorskip("pycolmap")
    asked = RefineOptions(preset="fast", start="auto")
    left_open = matched_work(scene[0], asked).amounts
    whole = matched_work(scene[0], asked.model_copy(update={"steps": 3000})).amounts
    assert left_open["coarse"] == 0.5 * whole["coarse"]
    assert left_open["fine"] == 0.5 * whole["fine"]
    given = asked.model_copy(update={"start": "given"})
    assert matched_work(scene[0], given).amounts["fine"] == (3000 - 1200) * 1.0


def test_no_model_of_matches_is_expected_of_more_posed_photos_than_are_mapped(scene, monkeypatch):
    pytest.importorskip("pycolmap")
    monkeypatch.setattr(map_images, "POSED_MAPPED_UP_TO", len(scene[0]) - 1)
    work = matched_work(scene[0], RefineOptions(preset="fast", start="auto")).amounts
    assert work["coarse"] == 1200
    assert (work["mapping"], "trying" in work) == (0, False)
    assert work["matching"] > 0


def test_mapping_is_more_work_where_photos_have_more_features(scene):
    pytest.importorskip("pycolmap")

    def mapping(times: int) -> float:
        cameras = tuple(c.resized(times * c.width, times * c.height) for c in scene[0].cameras)
        enlarged = replace(scene[0], cameras=cameras)
        return matched_work(enlarged, tiny_run(start="auto")).amounts["mapping"]

    assert mapping(1) < 0.5 * len(scene[0])
    assert mapping(100) > 5 * mapping(1)
