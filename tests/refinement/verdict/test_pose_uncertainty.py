"""The statement on each returned pose: in the caller's frame and unit, with a reason where nothing is known."""

from dataclasses import replace

import numpy as np
import pytest

from biresnerf.geometry.pose_error import pose_error
from biresnerf.geometry.similarity import Similarity, align_by_spread
from biresnerf.refinement.adjustment.cameras import Cameras
from biresnerf.refinement.finish.outcome import Finish
from biresnerf.refinement.numbers.finish import EvidenceNumbers
from biresnerf.refinement.start.refined_poses import RefinedPoses
from biresnerf.refinement.verdict.judgement import judge_poses
from biresnerf.refinement.verdict.pose_uncertainty import MATCHES_CONTRADICT, NO_EVIDENCE, pose_uncertainty
from tests.refinement.adjustment.rig import disturbed
from tests.refinement.finish.test_adjust_cameras import VIEWS, adjusted, begun

TRACK_MODEL_ERROR = EvidenceNumbers().track_model_error

SCALE = 50.0  # of the caller's world
CARRY = Similarity(SCALE, np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]]), np.array([7.0, -3, 100]))


@pytest.fixture(name="rng")
def generator():
    return np.random.default_rng(2)


def known_of(run, finish, judgement=None):
    joint, lost = run.optimiser.joint, run.optimiser.camera_errors.lost.numpy()
    return pose_uncertainty(run.scene.dataset, joint, finish, judgement, lost)


def noisy_run(folder, rng):
    """A run whose input is far off, in a world of its own, and the true poses there."""
    run, truth = begun(
        folder, rng, given=lambda poses: CARRY.apply_to_poses(disturbed(poses, rng, 0.1, 0.3)), noise_px=0.1
    )
    return run, CARRY.apply_to_poses(truth)


def test_errors_in_the_callers_frame_and_unit_are_within_the_bounds(tmp_path, rng):
    run, truth = noisy_run(tmp_path, rng)
    known = known_of(run, adjusted(run))
    assert {each.known_from for each in known} == {"matches"}
    poses = RefinedPoses.now(run.scene.dataset, run.optimiser.joint).world_from_cam
    errors = pose_error(poses, truth).aligned
    for figure, limit in (
        (errors.rotation_deg, [each.rotation_deg for each in known]),
        (errors.centre_percent, [each.position_percent for each in known]),
    ):
        assert np.median(limit) / (4 * TRACK_MODEL_ERROR) < figure.median < np.median(limit)
    share = [each.position / each.position_percent for each in known]
    np.testing.assert_allclose(
        share, np.linalg.norm(truth[:, :3, 3] - CARRY.translation, axis=1).mean() / 100, rtol=0.1
    )


def test_errors_along_the_axes_of_the_callers_world_are_as_large_as_the_covariance_says(tmp_path, rng):
    run, truth = noisy_run(tmp_path, rng)
    matrices = np.array([each.covariance for each in known_of(run, adjusted(run))])
    poses = RefinedPoses.now(run.scene.dataset, run.optimiser.joint).world_from_cam
    frame = align_by_spread(truth, poses)
    errors = Cameras.of(frame.apply_to_poses(truth)).apart(Cameras.of(poses)).reshape(-1, 6)
    squares = np.einsum("ni,nij,nj->n", errors, np.linalg.inv(matrices), errors)
    turned = np.kron(np.eye(2), CARRY.rotation)  # the right size along other axes
    elsewhere = np.einsum("ni,nij,nj->n", errors, np.linalg.inv(turned @ matrices @ turned.T), errors)
    assert 0.5 < TRACK_MODEL_ERROR**2 * squares.mean() / 6 < 2
    assert elsewhere.mean() > 1.5 * squares.mean()


def test_without_evidence_nothing_is_said_to_be_known(tmp_path, rng):
    run, _ = begun(tmp_path, rng)
    for each in known_of(run, Finish()):
        assert (each.rotation_deg, each.position, each.covariance) == (None, None, None)
        assert (each.known_from, each.why_unknown) == ("nothing", NO_EVIDENCE)


def test_a_pose_that_its_own_matches_contradict_is_not_known(tmp_path, rng):
    run, _ = begun(tmp_path, rng)
    finish = adjusted(run)
    judgement = run.judged()
    name = "contradicted_before" if judgement.verdict.returned == "input" else "contradicted"
    known = known_of(run, finish, replace(judgement, **{name: np.arange(VIEWS) == 3}))
    assert [each.why_unknown for each in known] == [
        MATCHES_CONTRADICT if i == 3 else None for i in range(VIEWS)
    ]


def test_matches_speak_for_poses_only_where_they_determine_most_of_them(tmp_path, rng, monkeypatch):
    monkeypatch.setattr(f"{judge_poses.__module__}.compare_on_unseen_views", lambda *_, **__: None)
    run, _ = noisy_run(tmp_path, rng)
    finish = adjusted(run)
    evidence = finish.fit.evidence
    of_few = replace(evidence, tracks=evidence.tracks.where(evidence.tracks.image < VIEWS // 3))
    open_ = replace(finish, fit=replace(finish.fit, evidence=of_few))
    told, untold, refused, never = (run.judged(each) for each in (finish, open_, finish.refused(), Finish()))
    assert (told.verdict.verdict, told.verdict.returned) == ("improved", "refined")
    assert 0 < untold.errors.known.sum() < VIEWS / 2
    assert (untold.verdict.verdict, untold.verdict.returned) == ("inconclusive", "input")
    assert "do not determine the poses of most photos" in untold.verdict.why[0]
    # Photos refused what matches prefer; or nobody adjusted to them, and nobody knows.
    assert [each.verdict.returned for each in (refused, never)] == ["input", "refined"]


def test_what_the_verdict_found_of_the_errors_is_what_the_report_has(tmp_path, rng):
    run, _ = noisy_run(tmp_path, rng)
    finish = adjusted(run)
    judgement = run.judged(finish)
    assert judgement.verdict.returned == "refined"
    assert judgement.errors is not None
    assert known_of(run, finish, judgement) == known_of(run, finish, replace(judgement, errors=None))
    # Where the input's poses come back, the evidence says that these are far off, or nothing.
    kept = replace(judgement, verdict=judgement.verdict.model_copy(update={"returned": "input"}))
    refined, given = ([each.rotation_deg for each in known_of(run, finish, of)] for of in (judgement, kept))
    assert all(each is None or each > 2 * max(refined) for each in given)
