"""The verdict on poses of known truth: the better set wins on either side, and suspicious photos are flagged."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from biresnerf.data import workload
from biresnerf.data.model.dataset import Dataset
from biresnerf.data.photos.images import ImageSet
from biresnerf.data.points.tracks import Tracks
from biresnerf.geometry.perturb import perturb_poses
from biresnerf.judging.compare import Rule
from biresnerf.refinement.optimise.method_changes import changed
from biresnerf.refinement.optimise.methods import BIRESNERF, Method, Recipe
from biresnerf.refinement.verdict.judgement import Judgement, judge_poses
from biresnerf.refinement.views import compare_rigs, pose_trials
from biresnerf.refinement.views.held_out_views import unseen_rounds
from biresnerf.studies.scenes import with_poses
from tests.refinement.tiny_scene import (
    CPU,
    TinyRun,
    given_scene,
    tiny_optimiser,
    tiny_options,
    tiny_set,
    true_matches,
)

pytestmark = pytest.mark.slow

VIEWS = 14
NUMBERS, VIEWED = BIRESNERF.verdict, BIRESNERF.views
OPTIONS = tiny_options(trial_steps=60, samples_per_step=8192)


@pytest.fixture(autouse=True)
def few_pictures(monkeypatch):
    """Trainings end when they have decided; else they would go on until their fields are worth a look."""
    monkeypatch.setattr(workload, "PICTURE_STEPS", 10)


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return tiny_set(tmp_path_factory.mktemp("scene"), views=VIEWS, size=24)


@pytest.fixture(scope="module")
def noisy(scene):
    return perturb_poses(scene[0].world_from_cam, 0.1, seed=1)


def judged(
    scene: tuple[Dataset, ImageSet],
    given: np.ndarray,
    refined: np.ndarray,
    tracks: Tracks | None = None,
    method: Method = BIRESNERF,
) -> Judgement:
    """The verdict on a run that was given one set of poses and ended with the other."""
    dataset, images = scene
    optimiser = tiny_optimiser(with_poses(dataset, refined), images, OPTIONS, [3], method)
    run = replace(given_scene(with_poses(dataset, given), images, [3]), tracks=tracks)
    return TinyRun(optimiser, run, Path()).judged()


def test_true_poses_in_place_of_noisy_ones_are_an_improvement(scene, noisy):
    verdict = judged(scene, noisy, scene[0].world_from_cam).verdict
    assert (verdict.verdict, verdict.returned) == ("improved", "refined")
    assert verdict.heldout.psnr.difference > 0.5
    assert verdict.heldout.strictly == 1


def test_true_poses_miss_the_photos_by_less_than_wrong_ones(scene):
    truth = scene[0].world_from_cam
    noisy, other = (perturb_poses(truth, 0.3, seed=seed) for seed in (2, 3))
    right, wrong = (judged(scene, noisy, refined).verdict.heldout.missed_px for refined in (truth, other))
    assert right < NUMBERS.blur_px < wrong
    # Whichever is better: photos that are near the input's renders tell that the refined poses are worse.
    assert judged(scene, truth, noisy).verdict.heldout.missed_px < NUMBERS.blur_px


def test_a_gain_that_may_be_blurs_must_stand_in_longer_trainings_unless_matches_speak(scene, noisy):
    truth, steps = scene[0].world_from_cam, OPTIONS.trial_steps
    alone, matched = (
        judged(scene, noisy, truth, tracks).verdict for tracks in (None, true_matches(scene[0]))
    )
    assert (alone.verdict, alone.heldout.steps) == ("improved", NUMBERS.longer * steps)
    assert NUMBERS.nearer * matched.moved_px < matched.heldout.missed_px < NUMBERS.blur_px
    assert (matched.verdict, matched.heldout.steps <= steps) == ("improved", True)
    sharp = changed(BIRESNERF, {"verdict.blur_px": 0.1})  # poses that miss by more are not what blur suits
    assert judged(scene, noisy, truth, method=sharp).verdict.heldout.steps <= steps


def test_a_gain_that_may_be_blurs_says_nothing_where_time_ends_before_longer_trainings(scene, noisy):
    (dataset, images), rounds_s = scene, 100.0
    optimiser = tiny_optimiser(dataset, images, OPTIONS, held_out=[3])
    run = TinyRun(optimiser, given_scene(with_poses(dataset, noisy), images, [3]), Path())
    run.forecast.rates["trial step"], run.forecast.left["judging"] = 1.0, rounds_s
    run.end_in(1.5 * rounds_s)
    hurried = run.judged().verdict
    assert hurried.heldout.psnr.finding == "better"
    assert (hurried.verdict, hurried.returned) == ("inconclusive", "input")
    assert "too much to tell" in hurried.why[0]


def test_other_views_are_left_out_only_until_they_decide(scene):
    truth = scene[0].world_from_cam
    first, second = unseen_rounds(VIEWS, [3], VIEWED)
    far, near = (judged(scene, perturb_poses(truth, noise, seed=1), truth).verdict for noise in (0.3, 0.02))
    assert far.heldout.psnr.count == len(first)
    assert near.heldout.psnr.count == len(first) + len(second)
    assert far.heldout.psnr.low > 0.5


def test_trainings_end_once_they_decide_but_for_pictures(scene, monkeypatch):
    dataset, images = scene
    truth, steps, pictured = dataset.world_from_cam, 200, 150
    monkeypatch.setattr(workload, "PICTURE_STEPS", pictured)
    options = OPTIONS.model_copy(update={"trial_steps": steps})
    optimiser = tiny_optimiser(dataset, images, options, held_out=[3])
    for noise, decided, other_rounds in ((0.3, steps // 4, 0), (0.02, steps, steps)):
        run = given_scene(with_poses(dataset, perturb_poses(truth, noise, seed=1)), images, [3])
        works: list[float] = []
        shares: list[float] = []
        parts = TinyRun(optimiser, run, Path())
        monkeypatch.setattr(parts.forecast, "advance", shares.append)
        monkeypatch.setattr(parts.forecast, "took", works.append)
        judgement = parts.judged()
        assert judgement.verdict.heldout.steps == decided
        assert works == [workload.JUDGING + 2 * (max(pictured, decided) + other_rounds)]
        if not other_rounds:
            assert shares[-1] == pytest.approx(decided / pictured), "pictures take the rest"
        assert judgement.renders.keys() == {3}


def test_trainings_end_once_they_agree_with_what_matches_say(scene, monkeypatch):
    monkeypatch.setattr(compare_rigs, "UNSEEN_PSNR", Rule(least=50.0))  # so large a gain there is not
    dataset, images = scene
    truth, noisy = dataset.world_from_cam, perturb_poses(dataset.world_from_cam, 0.3, seed=1)
    options = OPTIONS.model_copy(update={"trial_steps": 80})

    def steps(given: np.ndarray, refined: np.ndarray, tracks: Tracks | None) -> int:
        optimiser = tiny_optimiser(with_poses(dataset, refined), images, options, held_out=[3])
        run = replace(given_scene(with_poses(dataset, given), images, [3]), tracks=tracks)
        return TinyRun(optimiser, run, Path()).judged().verdict.heldout.steps

    matches = true_matches(dataset)
    assert steps(noisy, truth, matches) == steps(truth, noisy, matches) < 80
    assert steps(noisy, truth, None) == 80


def test_poses_that_a_broken_refinement_spoilt_are_not_returned(scene, noisy):
    verdict = judged(scene, scene[0].world_from_cam, noisy).verdict
    assert (verdict.verdict, verdict.returned) == ("kept_input", "input")
    assert verdict.heldout.psnr.difference < -0.5


def test_poses_that_stayed_are_unchanged(scene):
    poses = scene[0].world_from_cam
    verdict = judged(scene, poses, perturb_poses(poses, 1e-5, seed=2)).verdict
    assert (verdict.verdict, verdict.returned) == ("unchanged", "input")


def test_matches_alone_tell_good_poses_from_bad_ones(scene, noisy, monkeypatch):
    monkeypatch.setattr(f"{judge_poses.__module__}.compare_on_unseen_views", lambda *_, **__: None)
    truth, matches = scene[0].world_from_cam, true_matches(scene[0])
    better, worse = judged(scene, noisy, truth, matches), judged(scene, truth, noisy, matches)
    assert (better.verdict.verdict, worse.verdict.verdict) == ("improved", "kept_input")
    assert better.verdict.epipolar.error_px.after < 0.3 < better.verdict.epipolar.error_px.before
    assert np.nanmax(better.epipolar_px[1]) < np.nanmin(better.epipolar_px[0])


def test_swapping_the_sets_swaps_the_evidence(scene, noisy):
    truth, matches = scene[0].world_from_cam, true_matches(scene[0])
    forth, back = judged(scene, noisy, truth, matches).verdict, judged(scene, truth, noisy, matches).verdict
    # The refined rig is carried to the input's frame, which no evidence depends on but by rounding and the scene box.
    assert back.epipolar.error_px.difference == pytest.approx(-forth.epipolar.error_px.difference, abs=1e-3)
    assert back.heldout.psnr.difference == pytest.approx(-forth.heldout.psnr.difference, abs=0.1)


def test_lost_frames_fail_the_check(scene):
    upside_down = scene[0].world_from_cam.copy()
    upside_down[: VIEWS // 2 + 1, :3, :3] = upside_down[: VIEWS // 2 + 1, :3, :3] @ np.diag([-1.0, 1, -1])
    judgement = judged(scene, scene[0].world_from_cam, upside_down)
    assert judgement.verdict.verdict in ("failed_check", "kept_input")
    assert judgement.verdict.returned == "input"


def test_images_whose_poses_were_guessed_have_no_part_in_the_trials(scene, noisy):
    method = changed(BIRESNERF, {"verdict.longer": 1})
    dataset, images = scene
    truth = dataset.world_from_cam

    def judged_with_a_guess(guess: np.ndarray) -> Judgement:
        given, refined = noisy.copy(), truth.copy()
        given[1] = refined[1] = guess
        frames = list(with_poses(dataset, given).frames)
        frames[1] = replace(frames[1], pose_source="nearest-view")
        run = given_scene(replace(dataset, frames=tuple(frames)), images, [3])
        optimiser = tiny_optimiser(with_poses(dataset, refined), images, OPTIONS, [3], method)
        return TinyRun(optimiser, run, Path()).judged()

    found = judged_with_a_guess(truth[0])
    assert found.verdict.verdict == "improved"
    assert found.verdict.heldout.strictly == 1
    assert np.isnan(found.trial_psnr[:, 1]).all()
    assert np.isfinite(found.trial_psnr[:, 3]).all()
    # Trials are the same wherever the guess is, but for rounding of the frame that poses are carried to.
    other = judged_with_a_guess(truth[5])
    np.testing.assert_allclose(other.trial_psnr[0], found.trial_psnr[0], atol=0.05)


def test_trainings_are_the_same_again(scene):
    dataset, images = scene
    trials = pose_trials.PoseTrials(
        images, [2, 6], [dataset.world_from_cam], Recipe.of(OPTIONS, CPU, 2), 20, lambda: False
    )
    first, again = trials.begin(dataset.world_from_cam), trials.begin(dataset.world_from_cam)
    for trial in (first, again):
        trial.train(1.0)
    np.testing.assert_array_equal(first.scores().psnr, again.scores().psnr)


def test_a_camera_that_its_own_matches_contradict_is_named(scene, monkeypatch):
    monkeypatch.setattr(f"{judge_poses.__module__}.compare_on_unseen_views", lambda *_, **__: None)
    truth, refined = scene[0].world_from_cam, scene[0].world_from_cam.copy()
    refined[5] = refined[6]
    found = judged(scene, truth, refined, true_matches(scene[0]))
    assert np.flatnonzero(found.contradicted).tolist() == [5]
    assert not judged(scene, refined, truth, true_matches(scene[0])).contradicted.any()
