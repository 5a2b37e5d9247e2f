"""Adjusting cameras to tracks: against the truth, autograd and SciPy's least squares."""

import numba
import numpy as np
import pytest
import torch
from scipy.optimize import least_squares

from biresnerf.data.points.tracks import Tracks
from biresnerf.geometry.rigid_bodies import RigidBodies
from biresnerf.geometry.similarity import Similarity
from biresnerf.refinement.adjustment.adjustment import adjust_poses, misfit
from biresnerf.refinement.adjustment.cameras import Cameras
from biresnerf.refinement.adjustment.evidence import Evidence, PosePrior
from biresnerf.refinement.adjustment.lens.lenses import Lenses
from biresnerf.refinement.adjustment.track_term import ROBUST_SCALE, TrackTerm
from tests.refinement.adjustment import reference
from tests.refinement.adjustment.rig import disturbed, observed, pinholes, ring, rotation_errors_deg

# Two lenses: log focal length, k1, k2, principal point, p1, p2, aspect.
BENT = [
    [0.04, 0.05, -0.02, 0.01, -0.02, 0.004, -0.003, 0.01],
    [-0.02, 0.0, 0.03, 0.0, 0.005, -0.002, 0.001, -0.02],
]


@pytest.fixture(name="rng")
def generator():
    return np.random.default_rng(3)


def scene(rng, *, cameras=12, points=150, noise_px=0.0):
    truth = ring(cameras, rng)
    tracks = observed(truth, rng.uniform(-0.8, 0.8, (points, 3)), pinholes(cameras), rng, noise_px)
    return truth, Evidence(pinholes(cameras), tracks)


def loose(poses):
    return PosePrior.equal(poses, 0.1, 0.4)


@pytest.mark.parametrize("correction", [None, BENT], ids=["held", "free"])
@pytest.mark.parametrize("threads", [1, 4, 12], ids=lambda n: f"{n}-threads")  # of 9 points
def test_normal_equations_are_those_of_autograd(rng, correction, threads, monkeypatch):
    monkeypatch.setattr(numba, "get_num_threads", lambda: threads)
    truth, evidence = scene(rng, cameras=4, points=9, noise_px=2.0)
    cameras = Cameras.of(disturbed(truth, rng, 0.01, 0.05), correction and two_lenses(correction))
    term = TrackTerm(evidence.tracks, evidence.intrinsics, cameras, noise_px=1.5)
    at = term.linearise(cameras, 0.0)

    rotation, centre = torch.from_numpy(cameras.rotation), torch.from_numpy(cameras.centre)
    pinhole, index = (
        torch.from_numpy(term.lens[:, :4]),
        [torch.from_numpy(x) for x in (term.point, term.image)],
    )
    given, xy = torch.from_numpy(term.unknowns), torch.from_numpy(term.xy)
    before = torch.from_numpy(cameras.lens)

    def residuals(unknown, xyz):
        motion, change = unknown[:24].reshape(4, 6), unknown[24:].reshape(-1, 8)
        now = (before + change)[[0, 0, 1, 1]] if correction else torch.zeros(4, 8, dtype=torch.float64)
        lens = reference.with_lens(pinhole, now)
        return reference.track_residuals(
            *reference.moved(rotation, centre, motion), lens, xyz, *index, xy
        ).reshape(-1)

    unknown = torch.zeros(cameras.unknowns, dtype=torch.float64)
    to_cameras, to_points = torch.autograd.functional.jacobian(residuals, (unknown, given))
    r = residuals(unknown, given)
    square = (r.reshape(-1, 2) ** 2).sum(1) / 1.5**2
    weight = ((ROBUST_SCALE**2 / (ROBUST_SCALE**2 + square)) ** 2 / 1.5**2).repeat_interleave(2)
    j_cameras, j_points = to_cameras, to_points.reshape(len(r), 27)
    u = j_cameras.T @ (weight[:, None] * j_cameras)
    w = j_cameras.T @ (weight[:, None] * j_points)
    v = j_points.T @ (weight[:, None] * j_points)
    schur = u - w @ torch.linalg.solve(v, w.T)
    right = j_cameras.T @ (weight * r) - w @ torch.linalg.solve(v, j_points.T @ (weight * r))
    np.testing.assert_allclose(
        at.system.dense(), schur.numpy(), rtol=1e-7, atol=1e-7 * float(schur.abs().max())
    )
    np.testing.assert_allclose(at.right, right.numpy(), rtol=1e-7, atol=1e-7 * float(right.abs().max()))
    cost = float(reference.robust(square, ROBUST_SCALE).sum())
    assert term.cost(cameras, term.unknowns) == pytest.approx(cost, rel=1e-9)


def two_lenses(correction):
    """Of four cameras, two each."""
    return Lenses(np.array([0, 0, 1, 1]), np.array(correction), np.ones((2, 8)))


def test_cameras_return_to_the_truth_from_a_degree_away(rng):
    truth, evidence = scene(rng)
    start = disturbed(truth, rng, 0.02, 0.05)
    found = adjust_poses(start, evidence, loose(start))
    assert rotation_errors_deg(start, truth).mean() > 1
    assert rotation_errors_deg(found.world_from_cam, truth).max() < 1e-3
    assert found.used


def test_a_fifth_of_wrong_observations_is_ignored(rng):
    truth, evidence = scene(rng, points=300, noise_px=0.3)
    tracks = evidence.tracks
    wrong = rng.random(len(tracks.xy)) < 0.2
    xy = np.where(wrong[:, None], rng.uniform(0, 400, tracks.xy.shape), tracks.xy)
    start = disturbed(truth, rng, 0.005, 0.02)
    found = adjust_poses(
        start, Evidence(evidence.intrinsics, Tracks(tracks.point, tracks.image, xy)), loose(start)
    )
    clean = adjust_poses(start, evidence, loose(start))
    errors = [rotation_errors_deg(each.world_from_cam, truth).mean() for each in (found, clean)]
    assert errors[0] < 2 * errors[1]
    assert found.track_inliers == pytest.approx(0.8, abs=0.05)


def test_noise_is_measured(rng):
    truth, evidence = scene(rng, points=400, noise_px=0.4)
    start = disturbed(truth, rng, 0.01, 0.03)
    assert adjust_poses(start, evidence, loose(start)).track_noise_px == pytest.approx(0.4, rel=0.1)


def test_the_result_is_that_of_scipy(rng):
    truth, evidence = scene(rng, cameras=5, points=25, noise_px=0.5)
    start = disturbed(truth, rng, 0.01, 0.03)
    prior = PosePrior.equal(start, 0.02, 0.05)
    found = adjust_poses(start, evidence, prior)
    term = TrackTerm(
        evidence.tracks, evidence.intrinsics, Cameras.of(found.world_from_cam), found.track_noise_px
    )
    before = Cameras.of(start)

    def residuals(x):
        cameras = before.moved(x[:30])
        away = x[30:].reshape(-1, 3)[term.point] - cameras.centre[term.image]
        q = np.einsum("mji,mj->mi", cameras.rotation[term.image], away)
        r = term.lens[term.image, :2] * q[:, :2] / q[:, 2:] + term.lens[term.image, 2:4] - term.xy
        e = np.linalg.norm(r, axis=1) / found.track_noise_px
        # Whose square is the robust cost.
        robust = ROBUST_SCALE * e / np.sqrt(ROBUST_SCALE**2 + e**2)
        away_from_prior = (x[:30].reshape(5, 6) / ([0.02] * 3 + [0.05] * 3)).reshape(-1)
        return np.concatenate([robust, away_from_prior])

    first = Cameras.of(found.world_from_cam).apart(before).reshape(-1)
    term.settle(Cameras.of(found.world_from_cam))
    best = least_squares(residuals, np.concatenate([first, term.unknowns.reshape(-1)]), max_nfev=15)
    cost = float((residuals(np.concatenate([first, term.unknowns.reshape(-1)])) ** 2).sum())
    assert cost <= 2 * best.cost * (1 + 1e-4)
    exact = before.moved(best.x[:30]).world_from_cam()
    assert rotation_errors_deg(found.world_from_cam, exact).max() < 0.01


def test_left_out_tracks_tell_better_poses_from_worse(rng):
    truth, evidence = scene(rng, noise_px=0.3)
    worse = disturbed(truth, rng, 0.002, 0.005)
    noise = 0.3
    assert (misfit(truth, evidence, noise) < misfit(worse, evidence, noise)).all()


def test_left_out_tracks_do_not_mind_the_frame(rng):
    truth, evidence = scene(rng, noise_px=0.3)
    carried = Similarity(3.0, ring(1, rng)[0, :3, :3], np.array([5.0, 1.0, 2.0])).apply_to_poses(truth)
    noise = 0.3
    np.testing.assert_allclose(misfit(carried, evidence, noise), misfit(truth, evidence, noise), rtol=1e-5)


@pytest.mark.parametrize("deviation", [0.0, np.inf])
def test_priors_of_no_or_of_any_error_end_in_finite_poses(rng, deviation):
    truth, evidence = scene(rng, noise_px=0.3)
    start = disturbed(truth, rng, 0.01, 0.03)
    found = adjust_poses(start, evidence, PosePrior.equal(start, deviation, deviation))
    assert np.isfinite(found.world_from_cam).all()
    if deviation == 0.0:
        np.testing.assert_allclose(found.world_from_cam, start, atol=1e-9)
    else:
        assert rotation_errors_deg(found.world_from_cam, truth).max() < 0.2


def test_fixed_cameras_stay_and_the_others_come_to_them(rng):
    truth, evidence = scene(rng, noise_px=0.1)
    start = disturbed(truth, rng, 0.01, 0.03)
    start[:3] = truth[:3]
    known = np.r_[np.zeros(3), np.full(9, 0.1)]
    found = adjust_poses(
        start, evidence, PosePrior(start, known, known, RigidBodies.free(len(start)))
    ).world_from_cam
    np.testing.assert_allclose(found[:3], truth[:3], atol=1e-9)
    assert np.abs(found - truth).max() < 5e-3


@pytest.mark.parametrize("kind", ["random", "one point", "no parallax", "one plane", "behind", "too few"])
def test_degenerate_tracks_leave_finite_poses(rng, kind):
    truth = ring(3, rng)
    points = rng.uniform(-0.8, 0.8, (40, 3))
    if kind == "one point":
        points[:] = points[0]
    if kind == "one plane":
        points[:, 2] = 0
    if kind == "no parallax":
        truth[:, :3, 3] = truth[0, :3, 3]
    tracks = observed(truth, points if kind != "too few" else points[:2], pinholes(3), rng)
    if kind == "random":
        tracks = Tracks(tracks.point, tracks.image, rng.uniform(0, 400, tracks.xy.shape))
    if kind == "behind":
        truth[:, :3, :3] = truth[:, :3, :3] @ np.diag([-1.0, 1, -1])
    evidence = Evidence(pinholes(3), Tracks(tracks.point, tracks.image, np.nan_to_num(tracks.xy)))
    found = adjust_poses(truth, evidence, PosePrior.equal(truth, 0.01, 0.04))
    assert np.isfinite(found.world_from_cam).all()
    if kind == "too few":
        np.testing.assert_array_equal(found.world_from_cam, truth)
        assert not found.used


def test_photos_from_one_place_do_not_make_the_others_features_look_exact(rng):
    """As frames of a video that hardly differ: most observations lie in points that only these see."""
    truth, evidence = scene(rng, cameras=9, noise_px=0.4)
    start = disturbed(truth, rng, 0.005, 0.02)
    copied = observed(truth[:1], rng.uniform(-0.8, 0.8, (700, 3)), pinholes(1), rng, seen_by=1).xy
    point = np.concatenate([evidence.tracks.point, evidence.tracks.points + np.repeat(np.arange(700), 3)])
    image = np.concatenate([evidence.tracks.image, np.tile([0, 9, 10], 700)])
    tracks = Tracks(point, image, np.concatenate([evidence.tracks.xy, copied.repeat(3, axis=0)]))
    poses = np.concatenate([start, start[[0, 0]]])
    found = adjust_poses(poses, Evidence(pinholes(11), tracks), loose(poses))
    assert found.track_noise_px == pytest.approx(0.4, rel=0.15)
    alone = adjust_poses(start, evidence, loose(start))
    error, without = (rotation_errors_deg(each.world_from_cam[:9], truth).mean() for each in (found, alone))
    assert error < 1.2 * without
