"""Feature matches as evidence on two sets of poses, one of which is true."""

from __future__ import annotations

import numpy as np
import pytest

from biresnerf.data.photos.images import load_images
from biresnerf.data.points.tracks import Tracks
from biresnerf.geometry.perturb import perturb_poses
from biresnerf.refinement.numbers.choosing import VerdictNumbers
from biresnerf.refinement.verdict.pose_evidence import compare_on_matches, working_share
from biresnerf.refinement.views.compare_rigs import Rig
from biresnerf.report import EpipolarEvidence
from tests.refinement.tiny_scene import tiny_set, true_matches

NUMBERS = VerdictNumbers()

VIEWS = 14


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return tiny_set(tmp_path_factory.mktemp("scene"), views=VIEWS, size=24)


@pytest.fixture(scope="module")
def noisy(scene):
    return perturb_poses(scene[0].world_from_cam, 0.1, seed=1)


def test_the_working_share_is_of_the_long_sides(scene):
    dataset = scene[0]
    rig = Rig(dataset.world_from_cam, tuple(dataset.camera_of(i) for i in range(VIEWS)))
    assert working_share(rig, scene[1]) == 1
    assert working_share(rig, load_images(dataset, 12)) == 0.5


def test_matches_of_points_left_out_judge_and_photos_placed_by_a_guess_do_not(scene, noisy):
    dataset, truth = scene[0], scene[0].world_from_cam
    cameras = tuple(dataset.camera_of(i) for i in range(VIEWS))
    tracks = true_matches(dataset)
    guessed = np.arange(VIEWS) < VIEWS // 2
    worse = np.where(guessed[:, None, None], truth, noisy)
    before = np.where(guessed[:, None, None], noisy, truth)  # the guesses gain, the placed ones lose

    def found(placed: np.ndarray, tracks: Tracks, *, started: bool) -> EpipolarEvidence:
        rigs = Rig(before, cameras), Rig(worse, cameras)
        return compare_on_matches(*rigs, tracks, placed, NUMBERS.least_matched, started_from_matches=started)

    judged_by_all = found(~guessed, tracks, started=True)
    assert judged_by_all.error_px.finding != "better"
    assert judged_by_all.error_px.count == VIEWS - VIEWS // 2
    assert judged_by_all.independent
    assert judged_by_all.matches == len(tracks.split()[1].pairs()[0])
    few = tracks.where(tracks.point < 12 * VIEWS)  # too few points to spare any
    assert not found(~guessed, few, started=True).independent
    assert found(~guessed, few, started=False).independent
