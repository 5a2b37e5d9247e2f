"""Stated errors of poses: against the scatter over repeated noise, and where the evidence says nothing."""

from dataclasses import replace

import numpy as np
import pytest

from biresnerf.data.points.tracks import Tracks
from biresnerf.geometry.pose_error import camera_errors
from biresnerf.geometry.similarity import Similarity, align_by_spread
from biresnerf.refinement.adjustment.adjustment import adjust_poses
from biresnerf.refinement.adjustment.evidence import Evidence, PosePrior
from biresnerf.refinement.adjustment.lens.lenses import LENS, Lenses
from biresnerf.refinement.finish.expected_errors import bound_90, expected_errors
from biresnerf.refinement.numbers.finish import EvidenceNumbers
from tests.refinement.adjustment.rig import disturbed, observed, pinholes, ring

TRACK_MODEL_ERROR = EvidenceNumbers().track_model_error

CAMERAS = 9


@pytest.fixture(name="rng")
def generator():
    return np.random.default_rng(4)


def errors(poses, truth):
    aligned = camera_errors(align_by_spread(poses, truth).apply_to_poses(poses), truth)
    return np.radians(aligned.rotation_deg), aligned.centre


def expected(poses, evidence):
    preferred = adjust_poses(poses, evidence, PosePrior.equal(poses, 0.1, 0.4)).world_from_cam
    return expected_errors(poses, preferred, evidence)


def test_nine_in_ten_errors_of_adjusted_poses_are_within_the_bounds(rng):
    truth = ring(CAMERAS, rng)
    points, intrinsics, inside = rng.uniform(-0.8, 0.8, (120, 3)), pinholes(CAMERAS), []
    for seed in range(20):
        tracks = observed(truth, points, intrinsics, np.random.default_rng(seed), 0.5)
        evidence = Evidence(intrinsics, tracks)
        poses = adjust_poses(truth, evidence, PosePrior.equal(truth, np.inf, np.inf)).world_from_cam
        found = expected_errors(poses, poses, evidence)
        assert found.known.all()
        # The noise is all that is wrong here.
        turned, shifted = (bound / TRACK_MODEL_ERROR for bound in found.bounds_90())
        inside.append([e < b for e, b in zip(errors(poses, truth), (turned, shifted), strict=True)])
    assert np.mean(inside, axis=(0, 2)) == pytest.approx([0.9, 0.9], abs=0.05)


def test_true_poses_are_within_what_is_expected_of_adjusted_ones_and_others_are_not(rng):
    truth = ring(CAMERAS, rng)
    points, intrinsics = rng.uniform(-0.8, 0.8, (120, 3)), pinholes(CAMERAS)
    away = []
    for seed in range(20):
        tracks = observed(truth, points, intrinsics, np.random.default_rng(seed), 0.5)
        evidence = Evidence(intrinsics, tracks)
        poses = adjust_poses(truth, evidence, PosePrior.equal(truth, np.inf, np.inf)).world_from_cam
        # The noise is all that is wrong here.
        away.append(TRACK_MODEL_ERROR * expected_errors(truth, poses, evidence).deviations)
    assert np.mean(np.square(away)) == pytest.approx(
        1.0, abs=0.25
    )  # a median of squares of six degrees of freedom
    turned = disturbed(truth, rng, 0.02, 0.0)
    assert expected_errors(turned, poses, evidence).deviations > 5
    assert expected_errors(disturbed(truth, rng, 0.3, 0.0), poses, evidence).deviations == np.inf
    assert expected_errors(truth, truth, Evidence(intrinsics)).deviations == np.inf


def test_a_focal_length_that_is_not_known_widens_the_bounds(rng):
    truth = ring(CAMERAS, rng)
    tracks = observed(truth, rng.uniform(-0.8, 0.8, (120, 3)), pinholes(CAMERAS), rng, 0.5)
    held = Evidence(pinholes(CAMERAS), tracks)
    lenses = Lenses(np.zeros(CAMERAS, np.int64), np.zeros((1, LENS)), np.array([[0.02] + [0.0] * 7]))
    known, unknown = (expected_errors(truth, truth, each) for each in (held, replace(held, lenses=lenses)))
    for one, other in zip(known.bounds_90(), unknown.bounds_90(), strict=True):
        assert (other > 0.999 * one).all()
        assert other.mean() > 1.0005 * one.mean()


def test_errors_of_poses_off_the_evidence_hold_the_way_to_it(rng):
    truth = ring(CAMERAS, rng)
    tracks = observed(truth, rng.uniform(-0.8, 0.8, (120, 3)), pinholes(CAMERAS), rng, 0.2)
    poses = disturbed(truth, rng, 0.01, 0.04)
    found = expected(poses, Evidence(pinholes(CAMERAS), tracks))
    for error, moments in zip(
        errors(poses, truth), (found.moments[:, :3, :3], found.moments[:, 3:, 3:]), strict=True
    ):
        np.testing.assert_allclose(np.sqrt(np.trace(moments, axis1=1, axis2=2)), error, rtol=0.1, atol=0.002)


def test_a_camera_without_evidence_is_not_known_and_leaves_the_others_known(rng):
    truth = ring(CAMERAS, rng)
    tracks = observed(truth, rng.uniform(-0.8, 0.8, (120, 3)), pinholes(CAMERAS), rng, 0.2)
    with_all = expected(truth, Evidence(pinholes(CAMERAS), tracks))
    kept = tracks.image != 2
    found = expected(truth, Evidence(pinholes(CAMERAS), tracks.where(kept)))
    assert found.known.tolist() == [i != 2 for i in range(CAMERAS)]
    assert not found.by_tracks[2]
    others = found.known
    for of_all, alone in zip(with_all.bounds_90(), found.bounds_90(), strict=True):
        np.testing.assert_allclose(alone[others], of_all[others], rtol=0.5)


def test_photos_of_another_scene_are_not_known_and_leave_the_others_known(rng):
    truth = ring(CAMERAS + 3, rng)
    here, there = np.arange(CAMERAS), np.arange(CAMERAS, CAMERAS + 3)

    def seen_by(cameras, count):
        tracks = observed(
            truth[cameras], rng.uniform(-0.8, 0.8, (count, 3)), pinholes(len(cameras)), rng, 0.2
        )
        return replace(tracks, image=cameras[tracks.image])

    own, foreign = seen_by(here, 120), seen_by(there, 60)
    both = Tracks(
        np.concatenate([own.point, foreign.point + own.points]),
        np.concatenate([own.image, foreign.image]),
        np.concatenate([own.xy, foreign.xy]),
    )
    intrinsics = pinholes(len(truth))
    found = expected_errors(truth, truth, Evidence(intrinsics, both))
    assert found.known.tolist() == [True] * CAMERAS + [False] * 3
    assert found.by_tracks.all()
    alone = expected_errors(truth[:CAMERAS], truth[:CAMERAS], Evidence(pinholes(CAMERAS), own))
    for one, other in zip(found.bounds_90(), alone.bounds_90(), strict=True):
        np.testing.assert_allclose(one[:CAMERAS], other, rtol=0.1)


def test_nothing_is_known_of_wrong_matches(rng):
    truth = ring(CAMERAS, rng)
    tracks = observed(truth, rng.uniform(-0.8, 0.8, (120, 3)), pinholes(CAMERAS), rng)
    wrong = Tracks(tracks.point, tracks.image, rng.uniform(0, 400, tracks.xy.shape))
    assert not expected(truth, Evidence(pinholes(CAMERAS), wrong)).known.any()


def test_errors_are_carried_with_the_frame(rng):
    truth = ring(CAMERAS, rng)
    tracks = observed(truth, rng.uniform(-0.8, 0.8, (120, 3)), pinholes(CAMERAS), rng, 0.3)
    carry = Similarity(3.0, ring(1, rng)[0, :3, :3], np.array([5.0, 1.0, 2.0]))
    here = expected(truth, Evidence(pinholes(CAMERAS), tracks))
    there = expected(carry.apply_to_poses(truth), Evidence(pinholes(CAMERAS), tracks))
    for part in (slice(3), slice(3, 6)):
        one, other = (each[:, part, part] for each in (here.carried(carry).moments, there.moments))
        np.testing.assert_allclose(one, other, atol=0.02 * other.max())


@pytest.mark.parametrize("axes", [(1.0, 0.0, 0.0), (1.0, 1.0, 0.1), (1.0, 1.0, 1.0), (3.0, 1.0, 0.5)])
@pytest.mark.parametrize("mean", [(0.0, 0.0, 0.0), (2.0, 0.0, 0.0), (3.0, 3.0, 3.0)])
def test_one_length_in_ten_is_beyond_the_bound(rng, axes, mean):
    drawn = rng.normal(size=(200_000, 3)) * axes + mean
    moments = np.diag(np.square(axes)) + np.outer(mean, mean)
    bound = bound_90(moments[None], np.array([mean]))[0]
    assert (np.linalg.norm(drawn, axis=1) > bound).mean() == pytest.approx(0.1, abs=0.007)
