"""Cameras that are fixed, and cameras that move as one: adjusted, and how exactly they are known."""

from dataclasses import replace

import numpy as np
import pytest

from biresnerf.geometry.pose_error import camera_errors
from biresnerf.geometry.rigid import rigid_inverse
from biresnerf.geometry.rigid_bodies import RigidBodies
from biresnerf.geometry.similarity import Similarity, align_robust
from biresnerf.refinement.adjustment.adjustment import adjust_poses
from biresnerf.refinement.adjustment.cameras import Cameras
from biresnerf.refinement.adjustment.evidence import Evidence, PosePrior
from biresnerf.refinement.adjustment.solver.body_motions import BodyMoves, rigid_motion
from biresnerf.refinement.finish.expected_errors import expected_errors
from biresnerf.refinement.numbers.finish import EvidenceNumbers
from tests.refinement.adjustment.rig import disturbed, observed, pinholes, ring

TRACK_MODEL_ERROR = EvidenceNumbers().track_model_error

CAMERAS = 10
FIXED = RigidBodies(np.arange(CAMERAS), np.isin(np.arange(CAMERAS), [0, 4, 7]))
ONE_FIXED = RigidBodies(np.arange(CAMERAS), np.arange(CAMERAS) == 3)
PAIRS = RigidBodies(np.arange(CAMERAS) // 2, np.zeros(CAMERAS, np.bool_))
FIXED_PAIRS = RigidBodies(np.arange(CAMERAS) // 2, np.arange(CAMERAS) // 2 == 1)


@pytest.fixture(name="rng")
def generator():
    return np.random.default_rng(5)


def scene(rng, noise_px=0.0):
    truth = ring(CAMERAS, rng)
    tracks = observed(truth, rng.uniform(-0.8, 0.8, (120, 3)), pinholes(CAMERAS), rng, noise_px)
    return truth, Evidence(pinholes(CAMERAS), tracks)


def moved_bodies(truth, bodies, rng, rotation=0.02, position=0.05):
    """Every body off the truth, as a whole; fixed ones not at all."""
    poses = truth.copy()
    for body in np.unique(bodies.of[~bodies.fixed]):
        group, motion = bodies.of == body, disturbed(np.eye(4)[None], rng, rotation, position)[0]
        poses[group] = motion @ poses[group]
    return poses


def adjusted(start, evidence, bodies):
    return adjust_poses(start, evidence, PosePrior.equal(start, 0.1, 0.4, bodies)).world_from_cam


@pytest.mark.parametrize("bodies", [FIXED, PAIRS, FIXED_PAIRS], ids=["fixed", "pairs", "a fixed pair"])
def test_cameras_return_to_the_truth_in_the_frame_that_bodies_leave(rng, bodies):
    truth, evidence = scene(rng)
    start = moved_bodies(truth, bodies, rng)
    found = adjusted(start, evidence, bodies)
    # Pairs determine the scale, fixed cameras the whole frame.
    frame = Similarity.identity() if bodies.fixed.any() else align_robust(found, truth, with_scale=False)
    errors = camera_errors(frame.apply_to_poses(found), truth)
    assert camera_errors(start, truth).rotation_deg.max() > 1
    assert errors.rotation_deg.max() < 1e-3
    assert errors.centre.max() < 1e-4
    np.testing.assert_allclose(found[bodies.fixed], start[bodies.fixed], atol=1e-15)
    for group in bodies.shared:
        apart = [rigid_inverse(poses[group[0]]) @ poses[group[1]] for poses in (found, start)]
        np.testing.assert_allclose(*apart, atol=1e-9)


def test_where_all_cameras_are_fixed_none_moves_and_none_is_off(rng):
    truth, evidence = scene(rng, noise_px=0.5)
    held = RigidBodies(np.arange(CAMERAS), np.ones(CAMERAS, np.bool_))
    found = adjusted(truth, evidence, held)
    np.testing.assert_allclose(found, truth, atol=1e-15)
    errors = expected_errors(found, found, evidence, bodies=held)
    assert errors.known.all()
    np.testing.assert_array_equal(errors.covariance, 0)


def test_a_camera_that_is_known_exactly_fixes_its_body(rng):
    truth, evidence = scene(rng)
    start = moved_bodies(truth, FIXED_PAIRS, rng)
    free = PosePrior.equal(start, 0.1, 0.4, PAIRS)
    exact = np.where(np.arange(CAMERAS) == 2, 0.0, free.rotation)
    found = adjust_poses(start, evidence, replace(free, rotation=exact)).world_from_cam
    np.testing.assert_allclose(found[2:4], start[2:4], atol=1e-15)
    assert camera_errors(found, truth).rotation_deg.max() < 1e-3


def test_the_columns_of_bodies_are_the_derivative_of_their_rigid_motion(rng):
    cameras = Cameras.of(ring(CAMERAS, rng))
    moves = BodyMoves.among(cameras, FIXED_PAIRS)
    assert moves.bodies == 4
    to_first_order = moves.of_cameras(1e-6 * rng.normal(size=(4, 6)))
    exact = rigid_motion(cameras, FIXED_PAIRS, to_first_order)
    np.testing.assert_allclose(to_first_order, exact, atol=1e-10)
    moved = cameras.moved(1e5 * to_first_order.reshape(-1))
    rigid = cameras.moved(rigid_motion(cameras, FIXED_PAIRS, 1e5 * to_first_order).reshape(-1))
    lengths = [
        np.linalg.norm(each.centre[::2] - each.centre[1::2], axis=1) for each in (cameras, rigid, moved)
    ]
    np.testing.assert_allclose(lengths[1], lengths[0], rtol=1e-12)
    assert abs(lengths[2] - lengths[0]).max() > 1e-4


@pytest.mark.parametrize(
    "bodies", [FIXED, ONE_FIXED, PAIRS, FIXED_PAIRS], ids=["fixed", "one fixed", "pairs", "a fixed pair"]
)
def test_nine_in_ten_errors_of_tied_cameras_are_within_the_bounds(rng, bodies):
    truth, inside = ring(CAMERAS, rng), []
    points, intrinsics = rng.uniform(-0.8, 0.8, (100, 3)), pinholes(CAMERAS)
    free = PosePrior.equal(truth, np.inf, np.inf, bodies)
    for seed in range(20):
        tracks = observed(truth, points, intrinsics, np.random.default_rng(seed), 0.5)
        evidence = Evidence(intrinsics, tracks)
        poses = adjust_poses(truth, evidence, free).world_from_cam
        found = expected_errors(poses, poses, evidence, bodies=bodies)
        assert found.known.all()
        bounds = [bound / TRACK_MODEL_ERROR for bound in found.bounds_90()]
        off = camera_errors(bodies.input_from_optimised(poses, truth).apply_to_poses(poses), truth)
        errors = np.radians(off.rotation_deg), off.centre
        inside.append([(e <= b)[~bodies.fixed] for e, b in zip(errors, bounds, strict=True)])
    assert np.mean(inside, axis=(0, 2)) == pytest.approx([0.9, 0.9], abs=0.07)
