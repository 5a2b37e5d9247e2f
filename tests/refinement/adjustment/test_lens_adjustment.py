"""Lenses in the adjustment: recovered where the evidence determines them, else kept."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from biresnerf.data.points.tracks import Tracks
from biresnerf.geometry.camera.camera import Intrinsics
from biresnerf.geometry.camera.camera_models import Camera
from biresnerf.refinement.adjustment.adjustment import adjust_poses, misfit
from biresnerf.refinement.adjustment.evidence import Evidence, PosePrior
from biresnerf.refinement.adjustment.lens.lenses import LENS, Lenses, slopes_seen
from biresnerf.refinement.numbers.finish import EvidenceNumbers
from tests.refinement.adjustment import reference
from tests.refinement.adjustment.rig import FOCAL, SIZE, disturbed, observed, ring, rotation_errors_deg


@pytest.fixture(name="rng")
def generator():
    return np.random.default_rng(7)


def lens(count, *, focal=1.0, k1=0.0, k2=0.0, centre=(0.0, 0.0), p1=0.0, p2=0.0, aspect=1.0):
    """The principal point is off the middle by `centre` px."""
    x, y = SIZE / 2 + centre[0], SIZE / 2 + centre[1]
    camera = Camera("OPENCV", SIZE, SIZE, (FOCAL * focal, FOCAL * focal * aspect, x, y, k1, k2, p1, p2))
    return Intrinsics.from_cameras([camera] * count)


def unknown(count, *, focal=0.1, radial=1.0, centre=0.0, tangential=0.0, aspect=0.0, shared=True):
    of_image = np.zeros(count, np.int64) if shared else np.arange(count)
    rows = 1 if shared else count
    deviation = [focal, radial, radial, centre, centre, tangential, tangential, aspect]
    return Lenses(of_image, np.zeros((rows, LENS)), np.tile(deviation, (rows, 1)))


def scene(rng, true_lens, *, cameras=10, points=300, noise_px=0.3, poses=None):
    """Poses, and evidence that takes the lens for a plain one."""
    truth = ring(cameras, rng) if poses is None else poses
    tracks = observed(truth, rng.uniform(-0.8, 0.8, (points, 3)), true_lens, rng, noise_px)
    return truth, Evidence(lens(len(truth)), tracks)


def loose(poses):
    return PosePrior.equal(poses, 0.1, 0.4)


def test_a_wrong_lens_is_found_within_its_deviation(rng):
    truth, evidence = scene(rng, lens(10, focal=1 / 1.05, k1=0.06, k2=-0.2))
    start = disturbed(truth, rng, 0.01, 0.04)
    found = adjust_poses(start, replace(evidence, lenses=unknown(10)), loose(start))
    error = np.abs(found.lenses.correction - [[np.log(1 / 1.05), 0.06, -0.2, *(0.0,) * 5]])
    assert found.lenses.observable[:, :3].all()
    assert (error < 3 * found.lenses.deviation)[:, :3].all()
    assert error[0, 0] < 0.005
    held = adjust_poses(start, evidence, loose(start))
    errors = [rotation_errors_deg(each.world_from_cam, truth).mean() for each in (found, held)]
    assert errors[0] < 0.1
    assert errors[0] < 0.5 * errors[1]


def test_a_right_lens_stays(rng):
    truth, evidence = scene(rng, lens(10))
    start = disturbed(truth, rng, 0.01, 0.04)
    found = adjust_poses(start, replace(evidence, lenses=unknown(10)), loose(start)).lenses
    assert (np.abs(found.correction) < 3 * found.deviation)[:, :3].all()


def test_deviations_are_the_scatter_over_repeated_noise():
    truth = ring(8, np.random.default_rng(1))
    points, true_lens = np.random.default_rng(2).uniform(-0.8, 0.8, (150, 3)), lens(8, focal=1.02)
    errors, expected = [], []
    for seed in range(25):
        tracks = observed(truth, points, true_lens, np.random.default_rng(seed), 0.4)
        free = unknown(8, focal=10.0, radial=0.0)
        found = adjust_poses(truth, Evidence(lens(8), tracks, lenses=free), loose(truth)).lenses
        errors.append((found.correction[0, 0] - np.log(1.02)) ** 2)
        expected.append(found.deviation[0, 0] ** 2)
    assert np.mean(errors) == pytest.approx(np.mean(expected), rel=0.5)


def test_cameras_that_all_look_the_same_way_do_not_tell_the_focal_length(rng):
    poses = np.tile(np.eye(4), (9, 1, 1))
    poses[:, :3, 3] = np.stack([*rng.uniform(-1, 1, (2, 9)), np.full(9, -4.0)], 1)
    truth, evidence = scene(rng, lens(9, focal=1.05), poses=poses)
    found = adjust_poses(truth, replace(evidence, lenses=unknown(9, radial=0.0)), loose(truth))
    assert not found.lenses.observable.any()
    assert found.lenses.deviation[0, 0] > 0.1 * EvidenceNumbers().observable
    np.testing.assert_array_equal(found.lenses.correction, 0.0)
    assert np.isfinite(found.world_from_cam).all()


def test_a_parameter_is_given_up_alone(rng):
    # Near the image's middle, distortion does not show.
    truth, evidence = scene(rng, lens(10, focal=1.03))
    kept = np.linalg.norm(evidence.tracks.xy - SIZE / 2, axis=1) < 0.25 * SIZE
    tracks = evidence.tracks
    kept &= np.bincount(tracks.point, kept)[tracks.point] >= 2
    numbers = np.unique(tracks.point[kept], return_inverse=True)[1]
    evidence = Evidence(evidence.intrinsics, Tracks(numbers, tracks.image[kept], tracks.xy[kept]))
    found = adjust_poses(
        truth, replace(evidence, lenses=unknown(10, focal=0.3, radial=0.01)), loose(truth)
    ).lenses
    assert found.observable.tolist() == [[True, *(False,) * 7]]
    assert found.correction[0, 0] == pytest.approx(np.log(1.03), abs=3 * found.deviation[0, 0])
    assert np.isfinite(found.deviation[:, :3]).all()


def test_each_image_may_have_a_lens_of_its_own(rng):
    focal = rng.uniform(0.97, 1.03, 8)
    cameras = [Camera("SIMPLE_PINHOLE", SIZE, SIZE, (FOCAL * f, SIZE / 2, SIZE / 2)) for f in focal]
    truth, evidence = scene(rng, Intrinsics.from_cameras(cameras), cameras=8, noise_px=0.1)
    found = adjust_poses(
        truth, replace(evidence, lenses=unknown(8, radial=0.0, shared=False)), loose(truth)
    ).lenses
    assert found.observable[:, 0].all()
    assert (np.abs(found.correction[:, 0] - np.log(focal)) < 4 * found.deviation[:, 0]).all()


@pytest.mark.parametrize("deviation", [0.0, np.inf])
@pytest.mark.parametrize("kind", ["none", "three cameras", "one point", "random"])
def test_poor_evidence_ends_in_finite_lenses(rng, kind, deviation):
    truth, evidence = scene(rng, lens(3), cameras=3, points=40)
    tracks = evidence.tracks
    if kind == "none":
        tracks = None
    if kind == "one point":
        tracks = Tracks(tracks.point, tracks.image, np.full_like(tracks.xy, SIZE / 2))
    if kind == "random":
        tracks = Tracks(tracks.point, tracks.image, rng.uniform(0, SIZE, tracks.xy.shape))
    free = unknown(3, focal=deviation, radial=deviation)
    found = adjust_poses(truth, Evidence(evidence.intrinsics, tracks, lenses=free), loose(truth))
    assert np.isfinite(found.world_from_cam).all()
    assert np.isfinite(found.lenses.correction).all()
    assert not (found.lenses.observable & ~free.free).any()
    if kind in ("none", "one point") or deviation == 0.0:
        np.testing.assert_array_equal(found.lenses.correction, 0.0)


def test_left_out_tracks_tell_the_right_lens_from_a_wrong_one(rng):
    truth, evidence = scene(rng, lens(10, focal=0.97))
    right = Lenses(np.zeros(10, np.int64), np.array([[np.log(0.97), *(0.0,) * 7]]), np.zeros((1, LENS)))
    noise = 0.3
    assert (misfit(truth, replace(evidence, lenses=right), noise) < misfit(truth, evidence, noise)).all()


def test_all_of_a_lens_is_found_within_its_deviation(rng):
    truth, evidence = scene(
        rng, lens(12, focal=1.03, k1=0.05, k2=-0.1, centre=(15, -9), p1=0.004, p2=-0.006, aspect=1.004),
        cameras=12, points=600, noise_px=0.05,
    )  # fmt: skip
    start = disturbed(truth, rng, 0.01, 0.04)
    free = unknown(12, centre=0.05, tangential=0.05, aspect=0.02)
    found = adjust_poses(start, replace(evidence, lenses=free), loose(start))
    true = np.array([np.log(1.03), 0.05, -0.1, 15 / FOCAL, -9 / FOCAL, 0.004, -0.006, np.log(1.004)])
    assert found.lenses.observable.all()
    assert (np.abs(found.lenses.correction[0] - true) < 3 * found.lenses.deviation[0]).all()
    assert rotation_errors_deg(found.world_from_cam, truth).mean() < 0.1


def test_a_principal_point_off_the_middle_turns_all_cameras_alike_unless_it_is_found(rng):
    truth, evidence = scene(rng, lens(12, centre=(6, -5)), cameras=12, points=600, noise_px=0.05)
    held, freed = (
        adjust_poses(truth, replace(evidence, lenses=unknown(12, centre=centre)), loose(truth))
        for centre in (0.0, 0.03)
    )
    errors = [rotation_errors_deg(each.world_from_cam, truth).mean() for each in (held, freed)]
    assert errors[0] > 0.5
    assert errors[1] < 0.1 * errors[0]


def test_rays_of_a_corrected_lens_are_those_of_the_fixed_point(rng):
    rays = np.concatenate([rng.uniform(-0.5, 0.5, (20, 2)), np.ones((20, 1))], 1)
    correction = np.array([0.05, 0.1, -0.08, 0.01, -0.02, 0.004, -0.003, 0.01])
    exact = reference.seen_by(torch.from_numpy(rays), torch.from_numpy(correction))[:, :2].numpy()
    np.testing.assert_allclose(slopes_seen(correction, rays[:, :2]), exact, atol=1e-12)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("k1", [-1e3, -5.0, 0.0, 5.0, 1e3])
@pytest.mark.parametrize("k2", [-1e6, 0.0, 1e6])
@pytest.mark.parametrize("p1", [0.0, 10.0])
def test_a_lens_that_folds_has_finite_rays(k1, k2, p1):
    shown = np.array([[0.0, 0.0], [0.3, -0.2], [3.0, 2.0]])
    found = slopes_seen(np.array([0.5, k1, k2, 0.0, 0.0, p1, 0.0, 0.0]), shown)
    assert np.isfinite(found).all()
