"""What a run offers before its end: the best poses so far, by matches, and never worse than the input's."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from biresnerf.data.points.tracks import Tracks
from biresnerf.geometry.perturb import perturb_poses
from biresnerf.geometry.pose_error import pose_error
from biresnerf.judging.compare import LATER_MATCH_ERRORS
from biresnerf.refinement.stages.checkpoint import load_checkpoint
from biresnerf.refinement.verdict import judgement
from biresnerf.refinement.verdict.so_far import UNMEASURED, SoFar, poses_so_far
from tests.refinement.tiny_scene import TinyRun, given_scene, tiny_optimiser, tiny_options, tiny_set
from tests.refinement.verdict.test_judgement import VIEWS, true_matches, with_poses

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return tiny_set(tmp_path_factory.mktemp("scene"), views=VIEWS, size=24)


@pytest.fixture(autouse=True)
def no_training(monkeypatch):
    def refuse(*_, **__):
        raise AssertionError("a field is trained")

    monkeypatch.setattr(judgement, "compare_on_unseen_views", refuse)


def so_far(run: TinyRun) -> SoFar:
    made = run.optimiser
    return poses_so_far(run.scene, made.joint, made.camera_errors, made.recipe, run.state)


class Wandering:
    """A run that was given poses of a noise, and whose optimiser moves as told."""

    def __init__(self, scene, folder, given: float, *, matches: Tracks | None, verdict: bool = True) -> None:
        dataset, images = scene
        self.truth, self.folder, self._images, self._matches = dataset, folder, images, matches
        self._options = tiny_options(verdict=verdict)
        self.dataset = with_poses(dataset, self.noisy(given))
        self.run = self._begun()

    def _begun(self) -> TinyRun:
        run = replace(given_scene(self.dataset, self._images), tracks=self._matches)
        return TinyRun(tiny_optimiser(self.dataset, self._images, self._options), run, self.folder)

    def resume(self) -> None:
        """As another process does that has the checkpoint alone."""
        self.run.stages._save()
        self.run = self._begun()
        self.run.stages.restore(load_checkpoint(self.folder))

    def noisy(self, noise: float) -> np.ndarray:
        return perturb_poses(self.truth.world_from_cam, noise, seed=1)

    def at(self, noise: float) -> SoFar:
        """What is offered with the optimiser's poses at this noise."""
        return self.at_poses(self.noisy(noise))

    def at_poses(self, world_from_cam: np.ndarray) -> SoFar:
        """The same at any poses [n, 4, 4]."""
        optimiser = self.run.optimiser
        unit_from_cam = optimiser.frame.unit_from_world.apply_to_poses(world_from_cam)
        optimiser.poses.place(torch.from_numpy(unit_from_cam))
        return so_far(self.run)

    def error_deg(self, offered: SoFar) -> float:
        poses, _ = offered.offered(self.run.scene)
        return pose_error(poses, self.truth.world_from_cam).aligned_robust.rotation_deg.mean


def test_poses_that_get_worse_after_a_good_moment_are_not_offered(scene, tmp_path):
    run = Wandering(scene, tmp_path, 0.1, matches=true_matches(scene[0]))
    errors, gains = [], []
    for noise in (0.15, 0.05, 0.02, 0.06, 0.03, 0.005, 0.2):
        offered = run.at(noise)
        errors.append(run.error_deg(offered))
        gains.append(offered.verdict.epipolar.error_px.difference)
    given = pose_error(run.dataset.world_from_cam, run.truth.world_from_cam).aligned_robust.rotation_deg.mean
    assert errors[0] == pytest.approx(given), "worse than the input's"
    assert errors == sorted(errors, reverse=True)
    assert errors[2] == errors[3] == errors[4] > errors[5] == errors[6]
    assert errors[5] < given / 10
    assert gains[1:] == sorted(gains[1:]), "what is said is of the poses that are offered"


def test_the_inputs_poses_are_offered_until_others_are_better_and_the_latest_refined_ones_beside_them(
    scene, tmp_path
):
    run = Wandering(scene, tmp_path, 0.0, matches=true_matches(scene[0]))
    for noise in (0.05, 0.02, 0.1):
        offered = run.at(noise)
        assert (offered.verdict.verdict, offered.verdict.returned) == ("kept_input", "input")
        poses, dataset = offered.offered(run.run.scene)
        np.testing.assert_array_equal(poses, run.dataset.world_from_cam)
        assert dataset is run.dataset
        latest = pose_error(offered.refined.world_from_cam, run.noisy(noise)).aligned_robust
        assert latest.rotation_deg.max < 1e-3


def test_matches_offer_no_poses_that_they_do_not_determine(scene, tmp_path):
    matches = true_matches(scene[0])
    apart = matches.where(matches.point % 3 == matches.image % 3)  # three groups, that nothing joins
    open_, told = (Wandering(scene, tmp_path, 0.1, matches=each).at(0.01) for each in (apart, matches))
    assert open_.verdict.epipolar.error_px.finding == "better"
    assert (open_.verdict.verdict, open_.verdict.returned) == ("inconclusive", "input")
    assert "do not determine the poses of most photos" in open_.verdict.why[0]
    assert (told.verdict.verdict, told.verdict.returned) == ("improved", "refined")


def test_poses_that_matches_cannot_tell_from_the_best_take_its_place_but_never_drift_away_from_it(
    scene, tmp_path
):
    run = Wandering(scene, tmp_path, 0.1, matches=true_matches(scene[0]))
    best = run.at(0.01).verdict.epipolar.error_px.difference
    taken = [run.at(0.01 + 0.0001 * step) for step in range(40)]
    said = [offered.verdict.epipolar.error_px.difference for offered in taken]
    assert len(set(said)) > 2, "some of them were taken"
    assert min(said) > best - LATER_MATCH_ERRORS.least
    assert len(set(said[-10:])) == 1, "and others were not"


def test_a_resumed_run_offers_the_best_poses_of_the_one_that_was_interrupted(scene, tmp_path):
    run = Wandering(scene, tmp_path, 0.1, matches=true_matches(scene[0]))
    good, _ = run.at(0.01).offered(run.run.scene)
    run.at(0.2)
    run.resume()
    offered = so_far(run.run)
    assert offered.verdict.verdict == "improved"
    np.testing.assert_allclose(offered.offered(run.run.scene)[0], good, atol=1e-12)
    np.testing.assert_allclose(run.at(0.3).offered(run.run.scene)[0], good, atol=1e-12)


def test_a_lens_is_offered_with_the_poses_that_it_was_found_with(scene, tmp_path):
    run = Wandering(scene, tmp_path, 0.1, matches=true_matches(scene[0]))
    lenses, cameras = run.run.optimiser.lenses, run.dataset.cameras
    longer = tuple(
        replace(camera, params=(1.001 * camera.params[0], *camera.params[1:])) for camera in cameras
    )
    lenses.place(cameras, longer)
    run.at(0.01)
    lenses.place(cameras, cameras)
    offered = run.at(0.2)
    assert offered.refined.dataset.cameras[0].params == pytest.approx(longer[0].params)
    assert run.run.optimiser.lenses.refined(run.dataset).cameras[0].params == cameras[0].params


def test_without_matches_the_latest_poses_are_offered_and_it_is_said_that_nothing_measured_them(
    scene, tmp_path
):
    run = Wandering(scene, tmp_path, 0.1, matches=None)
    for noise in (0.01, 0.05):
        offered = run.at(noise)
        assert (offered.verdict.verdict, offered.verdict.returned) == ("inconclusive", "refined")
        assert offered.verdict.why[0] == UNMEASURED
        poses, _ = offered.offered(run.run.scene)
        assert pose_error(poses, run.noisy(noise)).aligned_robust.rotation_deg.max < 1e-3


def test_without_matches_poses_that_lost_the_inputs_frame_are_not_offered(scene, tmp_path):
    run = Wandering(scene, tmp_path, 0.1, matches=None)
    upside_down = run.truth.world_from_cam.copy()
    upside_down[: VIEWS // 2 + 1, :3, :3] = upside_down[: VIEWS // 2 + 1, :3, :3] @ np.diag([-1.0, 1, -1])
    offered = run.at_poses(upside_down)
    assert (offered.verdict.verdict, offered.verdict.returned) == ("failed_check", "input")
    np.testing.assert_array_equal(offered.offered(run.run.scene)[0], run.dataset.world_from_cam)


def test_a_run_that_is_to_have_no_verdict_offers_the_latest_poses(scene, tmp_path):
    run = Wandering(scene, tmp_path, 0.0, matches=true_matches(scene[0]), verdict=False)
    offered = run.at(0.05)
    assert offered.verdict is None
    assert run.error_deg(offered) > 1
