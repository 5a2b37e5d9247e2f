"""The input's poses as evidence: their accuracy is measured, and they are used accordingly."""

import math

import numpy as np
import pytest
import torch

from biresnerf.geometry.lie import so3_exp
from biresnerf.geometry.similarity import Similarity
from biresnerf.options.refine_options import RefineOptions
from biresnerf.refinement.adjustment.adjustment import adjust_poses
from biresnerf.refinement.adjustment.evidence import Evidence, PosePrior
from biresnerf.refinement.finish.given_poses import (
    SHARED_ERRORS,
    accuracy_report,
    accuracy_warnings,
    given_poses,
    loosened,
)
from tests.refinement.adjustment.rig import disturbed, observed, pinholes, ring, rotation_errors_deg

COUNT, ROTATION, POSITION = 40, 0.01, 0.06
# The input has a frame and a unit of its own.
INPUT_FROM_TRUTH = Similarity(
    2.5, np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]]), np.array([30.0, -20.0, 7.0])
)
BODY_FROM_CAM = np.eye(4)
BODY_FROM_CAM[:3, :3] = so3_exp(torch.tensor([0.3, -0.2, 0.1], dtype=torch.float64)).numpy()
BODY_FROM_CAM[:3, 3] = [0.4, -0.1, 0.25]
ALL = np.ones(COUNT, dtype=bool)


@pytest.fixture(name="rng")
def generator():
    return np.random.default_rng(4)


def given_by(truth, rng, *, body_from_cam=None, rotation=ROTATION, position=POSITION):
    """Noisy poses of the cameras, or of bodies that carry them, in the input's frame."""
    noisy = INPUT_FROM_TRUTH.apply_to_poses(disturbed(truth, rng, rotation, position))
    return noisy if body_from_cam is None else noisy @ np.linalg.inv(body_from_cam)


def test_the_errors_are_measured_and_no_offset_is_made_up():
    measured = []
    for seed in range(1, 9):
        rng = np.random.default_rng(seed)
        truth = ring(COUNT, rng)
        found = given_poses(given_by(truth, rng), truth, ALL)
        measured.append((found.rotation / ROTATION, found.position / POSITION))
        assert found.unit == pytest.approx(2.5, rel=0.02)
        assert found.offset is None
    assert np.array(measured) == pytest.approx(1.0, rel=0.25)
    assert np.mean(measured, axis=0) == pytest.approx(
        1.0, rel=0.1
    )  # 40 poses tell it to a tenth, eight sets to 4 %


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_an_offset_between_body_and_camera_is_found_and_taken_back(seed):
    rng = np.random.default_rng(seed)
    truth = ring(COUNT, rng)
    found = given_poses(given_by(truth, rng, body_from_cam=BODY_FROM_CAM), truth, ALL)
    assert found.offset is not None
    assert found.rotation == pytest.approx(ROTATION, rel=0.3)
    assert found.position == pytest.approx(POSITION, rel=0.3)
    cosine = (np.trace(found.offset.body_from_cam[:3, :3].T @ BODY_FROM_CAM[:3, :3]) - 1) / 2
    assert math.degrees(math.acos(min(1.0, cosine))) < 1.0
    assert rotation_errors_deg(found.world_from_cam, truth).mean() < 1.5 * math.degrees(ROTATION) * 1.6


def test_lost_cameras_have_no_say(rng):
    truth = ring(COUNT, rng)
    given = given_by(truth, rng)
    given[[3, 17]] = given[[22, 30]]
    found = given_poses(given, truth, ALL)
    assert found.rotation == pytest.approx(ROTATION, rel=0.3)
    assert (found.weight[[3, 17]] < 1e-3).all()
    assert np.median(found.weight) > 0.3


def test_few_cameras_tell_nothing(rng):
    truth = ring(COUNT, rng)
    assert given_poses(given_by(truth, rng), truth, np.arange(COUNT) < 5) is None


def test_exact_poses_are_known_exactly(rng):
    truth = ring(COUNT, rng)
    found = given_poses(INPUT_FROM_TRUTH.apply_to_poses(truth), truth, ALL)
    np.testing.assert_allclose(found.world_from_cam, truth, atol=1e-9)
    prior = found.prior(PosePrior.equal(disturbed(truth, rng, 0.01, 0.04), 0.02, 0.08))
    np.testing.assert_allclose(prior.world_from_cam, truth, atol=1e-6)


def test_two_priors_weigh_by_their_information(rng):
    truth = ring(COUNT, rng)
    found = given_poses(given_by(truth, rng), truth, ALL)
    other = PosePrior.equal(truth, SHARED_ERRORS * found.rotation, SHARED_ERRORS * found.position)
    prior = found.prior(other)
    np.testing.assert_allclose(prior.rotation, other.rotation / np.sqrt(1 + found.weight), rtol=1e-9)
    share = (found.weight / (1 + found.weight))[:, None]
    between = truth[:, :3, 3] + share * (found.world_from_cam[:, :3, 3] - truth[:, :3, 3])
    np.testing.assert_allclose(prior.world_from_cam[:, :3, 3], between, atol=1e-9)


def test_what_the_user_states_of_the_accuracy_holds_in_place_of_what_is_measured(rng):
    truth = ring(COUNT, rng)
    found = given_poses(given_by(truth, rng), truth, ALL)
    other = PosePrior.equal(truth, 0.004, 0.03)
    stated = found.as_stated(0.004, 0.0)
    prior = stated.prior(other)
    np.testing.assert_allclose(prior.rotation, 0.004 / np.sqrt(1 + found.weight), rtol=1e-9)
    np.testing.assert_allclose(prior.position, found.prior(other).position, rtol=1e-9)
    report = accuracy_report(stated)
    assert report.stated_rotation_deg == pytest.approx(math.degrees(0.004))
    assert report.stated_position is None
    assert report.rotation_deg == pytest.approx(math.degrees(found.rotation))


@pytest.mark.parametrize("known", [1e-300, 1e-12, 1e9])
def test_absurd_accuracies_leave_a_prior_that_can_be_used(rng, known):
    truth = ring(COUNT, rng)
    found = given_poses(given_by(truth, rng), truth, ALL).as_stated(known, known)
    other = PosePrior.equal(truth, 0.02, 0.08)
    prior = found.prior(other)
    for part in (prior.world_from_cam, prior.rotation, prior.position):
        assert np.isfinite(part).all()
    assert (prior.rotation > 0).all()
    if known > 1:
        assert not found.tells(other)
        np.testing.assert_allclose(prior.world_from_cam, truth, atol=1e-6)


def test_poses_far_less_exact_than_stated_are_warned_of(rng):
    truth = ring(COUNT, rng)
    found = given_poses(given_by(truth, rng), truth, ALL)
    silent, stated = (RefineOptions(input_position=p).resolved("cpu") for p in (0.0, 0.1))
    honest = found.as_stated(ROTATION, POSITION * found.unit)
    assert accuracy_warnings(honest, stated) == accuracy_warnings(None, silent) == ()
    assert "was not used" in accuracy_warnings(None, stated)[0]
    (warning,) = accuracy_warnings(found.as_stated(ROTATION / 10, 0.0), stated)
    assert "input_rotation_deg" in warning
    assert f"{math.degrees(found.rotation):.2g} degrees" in warning


def test_where_feature_matches_are_few_accurate_poses_help_and_wild_ones_do_no_harm(rng):
    truth = ring(COUNT, rng)
    tracks = observed(truth, rng.uniform(-0.6, 0.6, (60, 3)), pinholes(COUNT), rng, noise_px=0.5)
    evidence, start = Evidence(pinholes(COUNT), tracks), disturbed(truth, rng, 0.005, 0.02)
    loose = PosePrior.equal(start, 0.02, 0.08)
    alone = adjust_poses(start, evidence, loose).world_from_cam

    def error(rotation, position):
        given = given_by(truth, rng, rotation=rotation, position=position)
        prior = given_poses(given, alone, ALL).prior(loose)
        return rotation_errors_deg(adjust_poses(start, evidence, prior).world_from_cam, truth).mean()

    before = rotation_errors_deg(alone, truth).mean()
    assert error(0.001, 0.004) < 0.8 * before
    assert error(0.2, 1.0) < 1.05 * before


def test_a_prior_about_poses_far_worse_than_believed_holds_the_cameras_no_more(rng):
    truth = ring(COUNT, rng)
    tracks = observed(truth, rng.uniform(-0.6, 0.6, (60, 3)), pinholes(COUNT), rng, noise_px=0.5)
    evidence, start = Evidence(pinholes(COUNT), tracks), disturbed(truth, rng, 0.06, 0.3)
    believed = PosePrior.equal(start, 0.02, 0.08)
    held = adjust_poses(start, evidence, believed)
    looser = loosened(believed, held, evidence)
    assert looser is not None
    assert 0.02 < np.median(looser.rotation) < 3 * 0.06
    free = adjust_poses(start, evidence, looser)
    before, after = (rotation_errors_deg(each.world_from_cam, truth) for each in (held, free))
    assert after.mean() < 0.8 * before.mean()


def test_a_prior_that_believes_no_more_than_is_true_stays_and_fixed_cameras_stay_fixed(rng):
    truth = ring(COUNT, rng)
    tracks = observed(truth, rng.uniform(-0.6, 0.6, (200, 3)), pinholes(COUNT), rng, noise_px=0.5)
    evidence = Evidence(pinholes(COUNT), tracks)
    for error, changes in ((0.002, False), (0.05, True)):
        start = disturbed(truth, rng, error, 4 * error)
        start[:3] = truth[:3]
        prior = PosePrior.equal(start, 0.02, 0.08)
        prior.rotation[:3] = prior.position[:3] = 0.0
        looser = loosened(prior, adjust_poses(start, evidence, prior), evidence)
        assert (looser is not None) == changes
        if looser is not None:
            assert not looser.rotation[:3].any()
            assert not looser.position[:3].any()
