"""Choosing the poses to start from: a short training tells good poses from noisy ones, whoever found them."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from pydantic import TypeAdapter

from biresnerf.data.points.tracks import Tracks
from biresnerf.data.seeding.initial_poses import InitialPoses
from biresnerf.errors import Interrupted
from biresnerf.geometry.perturb import perturb_poses
from biresnerf.judging.compare import Rule
from biresnerf.options.refine_options import RefineOptions, ResolvedOptions
from biresnerf.progress import Monitor
from biresnerf.refinement.optimise.method_changes import changed
from biresnerf.refinement.optimise.methods import BIRESNERF, Recipe
from biresnerf.refinement.start import choose_start as start_module
from biresnerf.refinement.start.choose_start import choose_start, find_start
from biresnerf.refinement.start.first_step import pose_mobility, stage_lengths
from biresnerf.refinement.start.matches_explained import explained_from_one_place, matches_explained
from biresnerf.refinement.views.pose_trials import PoseTrials, trial_views
from tests.refinement.tiny_scene import CPU, tiny_recipe, tiny_set, true_matches

VIEWS, MOVING = 9, 100
SHORT = changed(BIRESNERF, {"start.moving_steps": MOVING, "views.trial_samples": 8192})


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return tiny_set(tmp_path_factory.mktemp("scene"), views=VIEWS, size=24)


@pytest.fixture(scope="module", autouse=True)
def short():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(start_module, "TRIAL_STEPS", 40)
        yield


def candidates(dataset, first: np.ndarray, second: np.ndarray) -> list[InitialPoses]:
    return [
        InitialPoses(first, "given", ("given",) * VIEWS),
        InitialPoses(second, "matches-incremental", ("matches-incremental",) * VIEWS),
    ]


def choose(images, tried: list[InitialPoses]) -> InitialPoses:
    return choose_start(tried, images, [0.0] * len(tried), tiny_recipe(SHORT), lambda: False)


@pytest.fixture(scope="module")
def chosen(scene, short) -> InitialPoses:
    """Of noisy given poses, and of true ones that matches found."""
    dataset, images = scene
    noisy = perturb_poses(dataset.world_from_cam, 0.15, seed=1)
    return choose(images, candidates(dataset, noisy, dataset.world_from_cam))


@pytest.mark.slow
def test_good_matches_win_over_noisy_given_poses(scene, chosen):
    dataset, _ = scene
    assert chosen.source == "matches-incremental"
    np.testing.assert_array_equal(chosen.world_from_cam, dataset.world_from_cam)
    assert chosen.trials[1].psnr > chosen.trials[0].psnr + 1
    np.testing.assert_array_equal(pose_mobility(chosen), [[0.0] * VIEWS, [1.0] * VIEWS])


@pytest.mark.slow
def test_trials_end_once_one_is_clearly_better(scene, monkeypatch):
    monkeypatch.setattr(start_module, "TRIAL_STEPS", 120)
    dataset, images = scene
    truth, works = dataset.world_from_cam, []
    for other in (perturb_poses(truth, 0.3, seed=1), truth):
        tried = candidates(dataset, other, truth)
        choose_start(tried, images, [0.0, 0.0], tiny_recipe(SHORT), lambda: False, works.append)
    assert works == [2 * 120 / 4, 2 * (120 + MOVING)]


@pytest.mark.slow
def test_trials_end_once_photos_prefer_poses_that_alone_explain_the_matches(scene, monkeypatch):
    monkeypatch.setattr(start_module, "TRIAL_STEPS", 120)
    monkeypatch.setattr(start_module, "CLEAR_TRIAL", Rule(least=50.0, errors=0))
    dataset, images = scene
    truth, tracks = dataset.world_from_cam, true_matches(dataset, noise_px=0.01)
    noisy = perturb_poses(truth, 0.3, seed=1)
    works = []

    def chosen(first: np.ndarray, second: np.ndarray) -> str:
        tried = candidates(dataset, first, second)
        explained = [matches_explained(dataset, tracks, c.world_from_cam) for c in tried]
        return choose_start(tried, images, explained, tiny_recipe(SHORT), lambda: False, works.append).source

    assert chosen(noisy, truth) == "matches-incremental"
    assert chosen(truth, noisy) == "given"
    assert chosen(truth, truth.copy()) == "given"  # both explain them, and no training tells them apart
    assert works == [2 * 120 / 4] * 3
    wrong = perturb_poses(truth, 0.3, seed=2)
    chosen(noisy, wrong)  # neither explains them
    assert works[-1] == 2 * (120 + MOVING)


def test_right_poses_explain_matches_and_wrong_or_unmatched_ones_do_not(scene):
    dataset = scene[0]
    truth, tracks = dataset.world_from_cam, true_matches(dataset, noise_px=0.01)
    assert matches_explained(dataset, tracks, truth) > 0.95
    assert matches_explained(dataset, tracks, perturb_poses(truth, 0.05, seed=1)) < 0.2
    folded = truth.copy()
    folded[6:] = truth[:3]  # a third of the views stand where others do
    assert matches_explained(dataset, tracks, folded) < 0.7
    of_six = tracks.where(tracks.image < 6)
    assert matches_explained(dataset, of_six, truth) == pytest.approx(
        6 / 9, abs=0.05
    )  # three photos unmatched


@pytest.mark.slow
def test_good_given_poses_win_over_wrong_matches(scene):
    dataset, images = scene
    wrong = perturb_poses(dataset.world_from_cam, 0.15, seed=2)
    chosen = choose(images, candidates(dataset, dataset.world_from_cam, wrong))
    assert chosen.source == "given"
    np.testing.assert_array_equal(pose_mobility(chosen), 1.0)
    assert [trial.source for trial in chosen.trials] == ["given", "matches-incremental"]
    np.testing.assert_array_equal(chosen.matched_poses, wrong)  # remembered, to be judged at the end
    kept = TypeAdapter(InitialPoses).validate_json(TypeAdapter(InitialPoses).dump_json(chosen))
    np.testing.assert_array_equal(kept.matched_poses, wrong)


def test_without_matches_no_matched_poses_are_remembered(scene):
    dataset, images = scene
    given = InitialPoses(dataset.world_from_cam, "given", ("given",) * VIEWS)
    found = find_start([given], dataset, images, None, tiny_recipe(SHORT), Monitor())
    assert found.matched_poses is None
    kept = TypeAdapter(InitialPoses).validate_json(TypeAdapter(InitialPoses).dump_json(found))
    assert kept.matched_poses is None


@pytest.mark.slow
def test_on_a_tie_the_given_poses_stay_if_matches_agree(scene):
    dataset, images = scene
    poses = dataset.world_from_cam
    assert choose(images, candidates(dataset, poses, poses.copy())).source == "given"


@pytest.mark.slow
def test_cameras_that_all_candidates_guess_have_no_say(scene):
    dataset, images = scene
    truth = dataset.world_from_cam
    noisy = perturb_poses(truth, 0.15, seed=1)
    placed = np.arange(VIEWS - 1)

    def with_a_guess(poses: np.ndarray, name: str) -> InitialPoses:
        guessed = poses.copy()
        guessed[-1] = guessed[0]  # where another photo was taken from
        return InitialPoses(guessed, name, (name,) * (VIEWS - 1) + ("nearest-view",))

    found = choose(images, [with_a_guess(noisy, "given"), with_a_guess(truth, "matches-incremental")])
    without = choose(
        images.of(placed),
        [
            InitialPoses(poses[placed], name, (name,) * (VIEWS - 1))
            for poses, name in ((noisy, "given"), (truth, "matches-incremental"))
        ],
    )
    assert [trial.psnr for trial in found.trials] == [trial.psnr for trial in without.trials]
    assert found.source == "matches-incremental"
    assert len(found.matched_poses) == len(found.world_from_cam) == VIEWS


@pytest.mark.slow
def test_poses_that_may_move_in_a_trial_improve(scene):
    dataset, images = scene
    noisy = perturb_poses(dataset.world_from_cam, 0.05, seed=1)
    trials = PoseTrials(
        images, trial_views(VIEWS, SHORT.views), [noisy], tiny_recipe(SHORT), 150, lambda: False
    )
    held, moved = (trials.begin(noisy, moving=moving) for moving in (False, True))
    for trial in (held, moved):
        trial.train(1.0)
    assert moved.scores().psnr.mean() > held.scores().psnr.mean() + 0.5


@pytest.mark.parametrize(
    ("scores", "explained", "decided"),
    [
        ([20.0, 22.1], [0.0, 0.0], True),  # clearly better, whatever matches say
        ([20.0, 21.9], [0.0, 0.0], False),  # neither explains them
        ([20.0, 20.4], [0.5, 0.95], True),  # photos prefer the one that alone explains them
        ([20.0, 20.2], [0.5, 0.95], False),  # by too little
        ([20.4, 20.0], [0.5, 0.95], False),  # photos and matches disagree
        ([20.0, 20.4], [0.95, 0.95], True),  # no training will tell apart what both explain
        ([20.0, 20.4, 20.3], [0.95, 0.95, 0.5], False),
    ],
)
def test_a_trial_has_decided_once_photos_clearly_prefer_poses_or_matches_agree_with_them(
    scores, explained, decided
):
    assert start_module._decided(scores, explained, SHORT.start) == decided
    assert start_module._decided(scores[::-1], explained[::-1], SHORT.start) == decided


@pytest.mark.slow
def test_where_poses_as_they_are_do_not_tell_those_win_that_improve_with_the_field(scene, monkeypatch):
    """As of a symmetric thing, whose matches give a model that is consistent but wrong."""
    dataset, images = scene
    monkeypatch.setattr(start_module, "CLEAR_TRIAL", Rule(least=50.0, errors=0))
    noisy = perturb_poses(dataset.world_from_cam, 0.05, seed=1)
    folded = dataset.world_from_cam[np.arange(VIEWS) // 2]  # half of the views stand where others do
    chosen = choose(images, candidates(dataset, folded, noisy))
    assert chosen.source == "matches-incremental"
    assert chosen.trials[1].psnr > chosen.trials[0].psnr + 1
    assert choose(images, candidates(dataset, noisy, folded)).source == "given"


def test_stages_are_shorter_where_matches_placed_the_cameras_and_their_lengths_were_left_open(scene):
    dataset, _ = scene
    given, matched = candidates(dataset, dataset.world_from_cam, dataset.world_from_cam)
    open_options = RefineOptions(preset="fast")
    recipe = Recipe.of(open_options.resolved("cpu"), CPU, 2)
    assert stage_lengths(given, open_options, recipe) == recipe
    shorter = stage_lengths(matched, open_options, recipe).options
    assert (shorter.steps, shorter.coarse_steps_min, shorter.coarse_steps_max) == (1500, 200, 400)
    assert (shorter.warmup_steps, shorter.trial_steps) == (100, 200)
    all_steps = RefineOptions(preset="fast", steps=3000)
    shorter = stage_lengths(matched, all_steps, recipe).options
    assert (shorter.steps, shorter.coarse_steps_min, shorter.coarse_steps_max) == (3000, 400, 800)
    fixed = RefineOptions(preset="fast", coarse_steps_min=500, coarse_steps_max=900)
    long = Recipe.of(fixed.resolved("cpu"), CPU, 2)
    assert stage_lengths(matched, fixed, long) == long
    for needed in ("short_where_matched", "adjustment"):
        whole = replace(recipe, method=replace(recipe.method, **{needed: False}))
        assert stage_lengths(matched, open_options, whole) == whole


def test_photos_from_one_place_are_told_from_others_by_their_matches(scene):
    dataset, _ = scene
    truth, tracks = dataset.world_from_cam, true_matches(dataset, noise_px=0.1)
    assert explained_from_one_place(dataset, tracks, truth) < 0.1
    rng, panned = np.random.default_rng(1), truth.copy()
    panned[:, :3, 3] = 0.0
    points, pair = rng.normal(size=(900, 3)) * 9, rng.integers(0, VIEWS, (900, 2))
    lens = dataset.camera_of(0).full()
    in_cam = np.einsum("msji,mj->msi", panned[pair][:, :, :3, :3], points)
    seen = (in_cam[..., 2] > 1).all(1) & (pair[:, 0] != pair[:, 1])
    xy = in_cam[..., :2] / in_cam[..., 2:] * [lens.fx, lens.fy] + [lens.cx, lens.cy]
    matches = Tracks.of_matches(pair[seen], xy[seen])
    assert matches is not None
    assert explained_from_one_place(dataset, matches, panned) > 0.99
    turned = perturb_poses(panned, 0.05, seed=1)
    assert explained_from_one_place(dataset, matches, turned) < 0.5


@pytest.mark.parametrize("asked", [{}, {"coarse_steps_min": 10}, {"coarse_steps_max": 20}])
@pytest.mark.parametrize("steps", [20, 60, 71, 100])
def test_a_run_of_few_steps_keeps_to_the_bounds_that_its_report_is_read_by(scene, steps, asked):
    dataset, _ = scene
    _, matched = candidates(dataset, dataset.world_from_cam, dataset.world_from_cam)
    options = RefineOptions(preset="fast", steps=steps, **asked)
    shorter = stage_lengths(matched, options, Recipe.of(options.resolved("cpu"), CPU, 2)).options
    assert ResolvedOptions.model_validate(shorter.model_dump()) == shorter


def test_cameras_that_matches_left_out_where_they_placed_most_are_not_reliable(scene):
    dataset, _ = scene
    matched, guess = "matches-incremental", "neighbours"
    everyone = [False] * 9
    for sources, guessed, unmatched in (
        ((matched,) * 8 + ("given",), everyone, [*everyone[1:], True]),
        ((matched,) * 2 + ("given",) * 7, everyone, everyone),
        (("given",) * 8 + (guess,), [*everyone[1:], True], everyone),
        ((guess,) * 9, everyone, everyone),
    ):
        start = InitialPoses(dataset.world_from_cam, sources[0], sources)
        assert start.guessed.tolist() == guessed
        assert start.unmatched.tolist() == unmatched
        assert start.reliable.tolist() == [not (a or b) for a, b in zip(guessed, unmatched, strict=True)]


def test_a_stop_ends_the_trial(scene):
    dataset, images = scene
    tried = candidates(dataset, dataset.world_from_cam, dataset.world_from_cam)
    with pytest.raises(Interrupted):
        choose_start(tried, images, [0.0, 0.0], tiny_recipe(SHORT), lambda: True)


@pytest.mark.slow
def test_a_start_survives_its_checkpoint(chosen):
    start = TypeAdapter(InitialPoses)
    back = start.validate_python(json.loads(json.dumps(start.dump_python(chosen))))
    np.testing.assert_array_equal(back.world_from_cam, chosen.world_from_cam)
    assert (back.source, back.sources, back.trials) == (chosen.source, chosen.sources, chosen.trials)
