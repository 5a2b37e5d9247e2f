"""Adjusting cameras to patches of photos: against autograd, and against the truth on a plane with a known texture."""

import numpy as np
import pytest
import torch

from biresnerf.geometry.camera.camera import Intrinsics
from biresnerf.geometry.camera.camera_models import Camera
from biresnerf.refinement.adjustment.adjustment import adjust_poses, misfit
from biresnerf.refinement.adjustment.cameras import Cameras
from biresnerf.refinement.adjustment.evidence import Evidence, PatchPhotos, PosePrior
from biresnerf.refinement.adjustment.lens.lenses import Lenses
from biresnerf.refinement.adjustment.patch_points import Surfaces, find_patches
from biresnerf.refinement.adjustment.patch_term import PatchTerm
from biresnerf.refinement.adjustment.splines import blurred, spline_coefficients
from biresnerf.refinement.numbers.finish import EvidenceNumbers
from tests.refinement.adjustment import reference
from tests.refinement.adjustment.rig import disturbed, look_at_origin, rotation_errors_deg

NUMBERS = EvidenceNumbers()

SIZE, FOCAL = 64, 80.0


# Two lenses: log focal length, k1, k2, principal point, p1, p2, aspect.
BENT = [
    [0.02, 0.05, -0.03, 0.005, -0.01, 0.002, -0.003, 0.01],
    [-0.01, 0.0, 0.04, 0.0, 0.005, -0.002, 0.001, -0.01],
]


@pytest.fixture(name="rng")
def generator():
    return np.random.default_rng(5)


class Plane:
    """Cameras above the plane z = 0, which has a smooth random texture."""

    def __init__(self, rng, cameras=9):
        azimuth = 2 * np.pi * np.arange(cameras) / cameras
        tilt = rng.uniform(0.15, 0.45, cameras)
        centres = np.stack([np.sin(tilt) * np.cos(azimuth), np.sin(tilt) * np.sin(azimuth), np.cos(tilt)], 1)
        self.truth = look_at_origin(3.0 * centres)
        self.waves = rng.normal(0, 6.0, (12, 2)), rng.uniform(0, 7, (3, 12))
        self.intrinsics = Intrinsics.from_cameras(
            [Camera("PINHOLE", SIZE, SIZE, (FOCAL, FOCAL, SIZE / 2, SIZE / 2))] * cameras
        )
        photos, depth = zip(*(self.view(pose) for pose in self.truth), strict=True)
        self.photos = PatchPhotos.stacked(list(photos))
        all_of_it = np.ones((SIZE, SIZE))
        self.surfaces = Surfaces(list(depth), [all_of_it] * cameras, [all_of_it > 0] * cameras)

    def view(self, pose):
        """Photo [h, w, 3] and depth along the rays."""
        at = (np.arange(SIZE) + 0.5 - SIZE / 2) / FOCAL
        x, y = np.meshgrid(at, at)
        ray = np.stack([x, y, np.ones_like(x)], -1)
        ray /= np.linalg.norm(ray, axis=-1, keepdims=True)
        world = ray @ pose[:3, :3].T
        depth = -pose[2, 3] / world[..., 2]
        on_plane = (pose[:3, 3] + depth[..., None] * world)[..., :2]
        frequency, phase = self.waves
        colour = np.stack([np.sin(on_plane @ frequency.T + p).mean(-1) for p in phase], -1)
        return (0.5 + 0.8 * colour).astype(np.float32), depth

    def evidence(self, poses, per_photo=40):
        return Evidence(
            self.intrinsics,
            None,
            find_patches(poses, self.intrinsics, self.photos, self.surfaces, per_photo, NUMBERS),
        )


def test_a_spline_goes_through_its_pixels(rng):
    photo = rng.uniform(0, 1, (20, 17, 2)).astype(np.float32)
    y, x = np.mgrid[3:17, 3:14]
    xy = torch.from_numpy(np.stack([x.ravel(), y.ravel()], 1) + 0.5)
    values = reference.bspline(torch.from_numpy(spline_coefficients(photo)).double(), xy).numpy()
    np.testing.assert_allclose(values, photo[y.ravel(), x.ravel()], atol=2e-5)


def test_a_blur_keeps_the_mean_and_lowers_the_contrast(rng):
    photo = rng.uniform(0, 1, (30, 30, 1)).astype(np.float32)
    smooth = blurred(photo, 1.0)
    assert smooth.mean() == pytest.approx(photo.mean(), rel=1e-3)
    assert smooth.std() < 0.5 * photo.std()


@pytest.mark.slow
@pytest.mark.parametrize("correction", [None, BENT], ids=["held", "free"])
def test_normal_equations_are_those_of_autograd(rng, correction):
    plane = Plane(rng, cameras=3)
    poses = disturbed(plane.truth, rng, 0.003, 0.005)
    evidence = plane.evidence(poses, per_photo=2)
    lens_of = [0, 0, 1]
    lenses = correction and Lenses(np.array(lens_of), np.array(correction), np.ones((2, 8)))
    cameras = Cameras.of(poses, lenses)
    term = PatchTerm(evidence.patches, evidence.intrinsics, cameras, NUMBERS)
    term.scale = 1.5
    at = term.linearise(cameras, 0.0)

    patches, count = evidence.patches, len(evidence.patches)
    rotation, centre = torch.from_numpy(cameras.rotation), torch.from_numpy(cameras.centre)
    coefficients = torch.from_numpy(term.coefficients.reshape(3, SIZE, SIZE, 3)).double()

    before = torch.from_numpy(cameras.lens)

    def residuals(unknown, scale):
        change = unknown[18:].reshape(-1, 8)
        lens = (before + change)[lens_of] if correction else torch.zeros(3, 8, dtype=torch.float64)
        turned, moved = reference.moved(rotation, centre, unknown[:18].reshape(3, 6))
        parts = []
        for i, j in zip(patches.point.tolist(), patches.target.tolist(), strict=True):
            pair = [int(patches.host[i]), j]
            parts.append(
                reference.patch_residuals(
                    turned[pair], moved[pair],
                    reference.with_lens(torch.from_numpy(term.lens[j, :4]), lens[j]), coefficients[j],
                    torch.from_numpy(term.values[i]),
                    reference.seen_by(torch.from_numpy(patches.rays[i]), lens[pair[0]]),
                    scale[i] * torch.from_numpy(patches.inverse_depth[i]),
                )
            )  # fmt: skip
        return torch.stack(parts).reshape(len(parts), -1)

    unknown = torch.zeros(cameras.unknowns, dtype=torch.float64)
    scale = torch.ones(count, dtype=torch.float64)
    r = residuals(unknown, scale)
    to_cameras, to_scale = torch.autograd.functional.jacobian(residuals, (unknown, scale), vectorize=True)
    square = torch.from_numpy(term.squares(cameras, np.ones(count)))
    variance = (r**2).mean(1) / square
    assert (variance >= NUMBERS.pixel_noise**2).all()
    assert (variance <= NUMBERS.pixel_noise**2 + NUMBERS.pixel_shift**2).all()
    weight = ((1.5**2 / (1.5**2 + square)) ** 2 / variance)[:, None].expand_as(r).reshape(-1)
    j_cameras, j_scales = to_cameras.reshape(-1, cameras.unknowns), to_scale.reshape(-1, count)
    flat = r.reshape(-1)
    u, w = j_cameras.T @ (weight[:, None] * j_cameras), j_cameras.T @ (weight[:, None] * j_scales)
    v = j_scales.T @ (weight[:, None] * j_scales) + torch.eye(count) / NUMBERS.scale_deviation**2
    system = u - w @ torch.linalg.solve(v, w.T)
    right = j_cameras.T @ (weight * flat) - w @ torch.linalg.solve(v, j_scales.T @ (weight * flat))
    np.testing.assert_allclose(
        at.system.dense(), system.numpy(), rtol=1e-4, atol=1e-5 * float(system.abs().max())
    )
    np.testing.assert_allclose(at.right, right.numpy(), rtol=1e-4, atol=1e-5 * float(right.abs().max()))


def test_cameras_return_to_the_truth(rng):
    plane = Plane(rng)
    start = disturbed(plane.truth, rng, 0.004, 0.004)
    found = adjust_poses(start, plane.evidence(start), PosePrior.equal(start, 0.02, 0.06))
    before, after = (rotation_errors_deg(poses, plane.truth) for poses in (start, found.world_from_cam))
    assert before.mean() > 0.2
    assert after.mean() < 0.2 * before.mean()
    assert found.halves.trusted


def test_true_poses_stay(rng):
    plane = Plane(rng)
    found = adjust_poses(plane.truth, plane.evidence(plane.truth), PosePrior.equal(plane.truth, 0.02, 0.06))
    # A tenth of a pixel is 0.07 degrees here.
    assert rotation_errors_deg(found.world_from_cam, plane.truth).max() < 0.07


def test_patches_that_have_nothing_in_common_move_no_camera(rng):
    plane = Plane(rng)
    start = disturbed(plane.truth, rng, 0.004, 0.004)
    evidence = plane.evidence(start)
    noise = rng.uniform(0, 1, plane.photos.values.shape).astype(np.float32)
    photos = PatchPhotos.stacked([noise[: SIZE * SIZE].reshape(SIZE, SIZE, 3)] * 9)
    photos.values[:] = noise
    patches = find_patches(start, plane.intrinsics, photos, plane.surfaces, 40, NUMBERS)
    found = adjust_poses(
        start, Evidence(evidence.intrinsics, None, patches), PosePrior.equal(start, 0.02, 0.06)
    )
    assert not found.halves.trusted
    assert not found.used
    np.testing.assert_array_equal(found.world_from_cam, start)


def test_left_out_patches_tell_better_poses_from_worse(rng):
    plane = Plane(rng)
    worse = disturbed(plane.truth, rng, 0.003, 0.003)
    evidence = plane.evidence(worse)
    assert (misfit(plane.truth, evidence, 1.0) < misfit(worse, evidence, 1.0)).all()


@pytest.mark.parametrize("kind", ["empty field", "masked", "one colour"])
def test_photos_without_patches_are_no_evidence(rng, kind):
    plane = Plane(rng, cameras=4)
    surfaces, photos = plane.surfaces, plane.photos
    if kind == "empty field":
        surfaces = Surfaces(surfaces.depth, [np.zeros((SIZE, SIZE))] * 4, surfaces.counts)
    if kind == "masked":
        surfaces = Surfaces(surfaces.depth, surfaces.opacity, [np.zeros((SIZE, SIZE), np.bool_)] * 4)
    if kind == "one colour":
        photos = PatchPhotos.stacked([np.full((SIZE, SIZE, 3), 0.5, np.float32)] * 4)
    assert find_patches(plane.truth, plane.intrinsics, photos, surfaces, 40, NUMBERS) is None
