"""Fisheyes in the adjustment: poses come to the truth, errors are in pixels of the photo."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from biresnerf.geometry.camera.camera import Intrinsics, directions_in_cam, project
from biresnerf.geometry.camera.camera_models import Camera
from biresnerf.refinement.adjustment.adjustment import adjust_poses
from biresnerf.refinement.adjustment.cameras import Cameras
from biresnerf.refinement.adjustment.evidence import Evidence, PosePrior
from biresnerf.refinement.adjustment.lens.corrected_camera import corrected_camera
from biresnerf.refinement.adjustment.lens.fisheyes import with_corrections
from biresnerf.refinement.adjustment.lens.lenses import Lenses
from biresnerf.refinement.adjustment.track_term import TrackTerm
from tests.refinement.adjustment.rig import disturbed, observed, ring, rotation_errors_deg

CAMERAS = 8
FISHEYE = Camera("OPENCV_FISHEYE", 800, 800, (250.0, 250.0, 402.0, 398.0, 0.02, -0.005, 0.001, 0.0))
PINHOLE = Camera("PINHOLE", 400, 400, (500.0, 505.0, 201.0, 199.0))
CARRIED = Camera("EUCM", 800, 800, (300.0, 300.0, 402.0, 398.0, 0.6, 1.1))
ALL, SOME = [FISHEYE] * CAMERAS, [FISHEYE, PINHOLE] * (CAMERAS // 2)
WITH_CARRIED = [CARRIED, PINHOLE] * (CAMERAS // 2)


@pytest.fixture(name="rng")
def generator():
    return np.random.default_rng(6)


def scene(rng, cameras, noise_px=0.0):
    """Points up to 115 degrees from the axes of fisheyes; near the middle where pinholes look."""
    truth, far = ring(CAMERAS, rng), 8.0 if cameras is ALL else 0.8
    intrinsics = Intrinsics.from_cameras(cameras)
    tracks = observed(truth, rng.uniform(-far, far, (200, 3)), intrinsics, rng, noise_px, seen_by=CAMERAS)
    rays = directions_in_cam(intrinsics, torch.from_numpy(tracks.image), torch.from_numpy(tracks.xy))
    return truth, Evidence(intrinsics, tracks.where((rays[:, 2] > np.cos(np.radians(115))).numpy()))


@pytest.mark.parametrize("cameras", [ALL, SOME, WITH_CARRIED], ids=["all", "some", "carried"])
def test_fisheyes_return_to_the_truth(rng, cameras):
    truth, evidence = scene(rng, cameras)
    start = disturbed(truth, rng, 0.02, 0.05)
    found = adjust_poses(start, evidence, PosePrior.equal(start, 0.1, 0.4))
    assert rotation_errors_deg(start, truth).mean() > 1
    assert rotation_errors_deg(found.world_from_cam, truth).max() < 1e-3


def test_points_behind_the_axis_are_among_the_evidence(rng):
    truth, evidence = scene(rng, ALL)
    points = TrackTerm(evidence.tracks, evidence.intrinsics, Cameras.of(truth), 1.0).unknowns
    seen = points[evidence.tracks.point] - truth[evidence.tracks.image, :3, 3]
    depth = np.einsum("mj,mj->m", seen, truth[evidence.tracks.image, :3, 2])
    assert (depth < 0).mean() > 0.1


def test_errors_of_fisheyes_are_in_pixels_of_the_photo(rng):
    truth, evidence = scene(rng, ALL)
    term = TrackTerm(evidence.tracks, evidence.intrinsics, Cameras.of(truth), 1.0)
    off = disturbed(truth, rng, 1e-5, 0.0)
    in_cam = np.einsum(
        "mji,mj->mi",
        off[term.image, :3, :3],
        term.unknowns[term.point] - off[term.image, :3, 3],
    )
    seen = project(evidence.intrinsics, torch.from_numpy(term.image), torch.from_numpy(in_cam)).numpy()
    of_photo = np.linalg.norm(seen - term.xy, axis=1)
    np.testing.assert_allclose(term.errors_px(Cameras.of(off)), of_photo, rtol=0.01)


def test_the_noise_of_fisheyes_is_measured(rng):
    truth, evidence = scene(rng, ALL, noise_px=0.4)
    start = disturbed(truth, rng, 0.01, 0.03)
    found = adjust_poses(start, evidence, PosePrior.equal(start, 0.1, 0.4))
    assert found.track_noise_px == pytest.approx(0.4, rel=0.1)


def test_a_pinhole_among_fisheyes_finds_its_focal_length(rng):
    truth, evidence = scene(rng, SOME)
    long = Camera("PINHOLE", 400, 400, (520.0, 505.0 * 1.04, 201.0, 199.0))
    wrong = Intrinsics.from_cameras([FISHEYE, long] * (CAMERAS // 2))
    deviation = np.array([[0.0] * 8, [0.1] + [0.0] * 7])
    lenses = Lenses(np.arange(CAMERAS) % 2, np.zeros((2, 8)), deviation)
    found = adjust_poses(
        truth, Evidence(wrong, evidence.tracks, lenses=lenses), PosePrior.equal(truth, 0.1, 0.4)
    )
    np.testing.assert_allclose(np.exp(found.lenses.correction[:, 0]), [1, 1 / 1.04], rtol=1e-4)


ONE_LENS = np.zeros(CAMERAS, np.int64)


def unknown_lens(*, focal=0.5, tangential=0.05):
    deviation = [[focal, 0.5, 0.5, 0.2, 0.2, tangential, tangential, 0.0]]
    return Lenses(ONE_LENS, np.zeros((1, 8)), np.array(deviation))


WRONG = np.array([np.log(1.02), 0.004, -0.002, 0.01, -0.006, 0.001, -0.0005, 0.0])


@pytest.mark.parametrize("camera", [FISHEYE, CARRIED], ids=["own", "carried"])
def test_a_wrong_fisheye_is_found(rng, camera):
    truth, evidence = scene(rng, [camera] * CAMERAS)
    wrong = with_corrections(evidence.intrinsics, ONE_LENS, -WRONG[None])
    start = disturbed(truth, rng, 0.01, 0.02)
    prior = PosePrior.equal(start, 0.1, 0.4)
    found = adjust_poses(start, Evidence(wrong, evidence.tracks, lenses=unknown_lens()), prior)
    right = with_corrections(wrong, ONE_LENS, found.lenses.correction)
    for name in ("fx", "fy", "cx", "cy"):
        np.testing.assert_allclose(getattr(right, name), getattr(evidence.intrinsics, name), rtol=1e-5)
    np.testing.assert_allclose(right.distortion, evidence.intrinsics.distortion, atol=5e-5)
    held = adjust_poses(start, Evidence(wrong, evidence.tracks), prior)
    assert rotation_errors_deg(found.world_from_cam, truth).max() < 1e-3
    assert rotation_errors_deg(held.world_from_cam, truth).max() > 0.1


def test_deviations_of_a_fisheye_are_the_scatter_over_repeated_noise():
    errors, expected = [], []
    for seed in range(20):
        truth, evidence = scene(np.random.default_rng(6), ALL)
        noise = np.random.default_rng(seed).normal(0, 0.4, evidence.tracks.xy.shape)
        tracks = replace(evidence.tracks, xy=evidence.tracks.xy + noise)
        told = Evidence(evidence.intrinsics, tracks, lenses=unknown_lens(focal=10.0, tangential=0.0))
        found = adjust_poses(truth, told, PosePrior.equal(truth, 0.1, 0.4)).lenses
        errors.append(found.correction[0, :5] ** 2)
        expected.append(found.deviation[0, :5] ** 2)
    np.testing.assert_allclose(np.mean(errors, 0), np.mean(expected, 0), rtol=0.8)


@pytest.mark.parametrize("camera", [FISHEYE, CARRIED], ids=["own", "carried"])
def test_a_corrected_fisheye_shows_what_the_correction_says(camera):
    small = WRONG * [1, 1, 1, 1, 1, 0, 0, 0]
    before = Intrinsics.from_cameras([camera])
    expected = with_corrections(before, np.zeros(1, np.int64), small[None])
    found = Intrinsics.from_cameras([corrected_camera(camera, small)])
    xy = torch.rand(200, 2, dtype=torch.float64) * 800
    rays = directions_in_cam(expected, torch.zeros(200, dtype=torch.int64), xy)
    shown = project(found, torch.zeros(200, dtype=torch.int64), rays)
    np.testing.assert_allclose(shown, xy, atol=1e-6 if camera is FISHEYE else 0.3)
