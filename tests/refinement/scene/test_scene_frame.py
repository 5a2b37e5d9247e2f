"""The unit frame: the scene inside the box, whatever frame and scale the input came in."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from biresnerf.data.photos.images import ImageSet
from biresnerf.data.points.tracks import Tracks
from biresnerf.geometry.camera.camera_models import Camera
from biresnerf.geometry.perturb import perturb_poses
from biresnerf.geometry.similarity import Similarity
from biresnerf.refinement.numbers.scene import FrameNumbers
from biresnerf.refinement.scene.scene_depth import matched_depth
from biresnerf.refinement.scene.scene_frame import scene_frame
from tests.refinement.tiny_scene import tiny_set

FRAME = FrameNumbers()


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return tiny_set(tmp_path_factory.mktemp("scene"), views=9)


def moved(dataset, similarity: Similarity):
    poses = similarity.apply_to_poses(dataset.world_from_cam)
    return replace(
        dataset,
        frames=tuple(replace(f, world_from_cam=p) for f, p in zip(dataset.frames, poses, strict=True)),
    )


def unit_poses(dataset, images):
    return scene_frame(dataset.world_from_cam, images, FRAME).unit_from_world.apply_to_poses(
        dataset.world_from_cam
    )


@pytest.mark.parametrize(("scale", "shift"), [(1e-3, 0.0), (250.0, 1e4), (1.0, -70.0)])
def test_scale_and_origin_of_the_input_do_not_matter(scene, scale, shift):
    dataset, images = scene
    other = moved(dataset, Similarity(scale, np.eye(3), np.array([shift, -shift, 0.5 * shift])))
    np.testing.assert_allclose(unit_poses(other, images), unit_poses(dataset, images), atol=1e-6)
    one, two = (
        scene_frame(dataset.world_from_cam, images, FRAME),
        scene_frame(other.world_from_cam, images, FRAME),
    )
    for name in ("distance", "pixel", "far", "unbounded"):
        assert getattr(two, name) == pytest.approx(getattr(one, name), rel=1e-6)


def test_the_axes_of_the_input_only_turn_the_unit_frame(scene):
    dataset, images = scene
    turn = Rotation.from_euler("xyz", [20, 60, -130], degrees=True).as_matrix()
    other = moved(dataset, Similarity(3.0, turn, np.array([5.0, 6.0, 7.0])))
    expected = Similarity(1.0, turn, np.zeros(3)).apply_to_poses(unit_poses(dataset, images))
    np.testing.assert_allclose(unit_poses(other, images), expected, atol=1e-9)


def test_the_scene_lies_in_the_box_and_the_cameras_outside_looking_in(scene):
    dataset, images = scene
    frame = scene_frame(dataset.world_from_cam, images, FRAME)
    # The synthetic scene reaches from -0.8 to 0.9 about the origin.
    corners = np.array([[x, y, z] for x in (-0.7, 0.7) for y in (-0.7, 0.7) for z in (-0.5, 0.8)])
    assert np.abs(frame.unit_from_world.apply(corners)).max() < 1.0
    assert np.abs(frame.unit_from_world.apply(corners)).max() > 0.3  # and fills it
    centres = unit_poses(dataset, images)[:, :3, 3]
    assert np.linalg.norm(centres, axis=1).min() > 1
    assert np.linalg.norm(centres, axis=1).mean() == pytest.approx(frame.distance, rel=0.05)
    assert not frame.unbounded
    np.testing.assert_allclose(frame.background, 1.0)


def test_a_pixel_is_as_wide_as_two_neighbouring_rays_are_apart_at_the_centre(scene):
    dataset, images = scene
    frame = scene_frame(dataset.world_from_cam, images, FRAME)
    fx = images.cameras[0].full().fx
    assert frame.pixel == pytest.approx(frame.distance / fx, rel=1e-6)


def test_the_lens_decides_how_far_the_box_reaches(scene):
    """Seen through a lens that squeezes the picture, the same pixels lie farther out."""
    dataset, images = scene
    images = replace(images, alpha=None)

    def half(camera: Camera) -> float:
        bent = replace(images, cameras=(camera,) * len(dataset))
        return 1 / scene_frame(dataset.world_from_cam, bent, FRAME).unit_from_world.scale

    w = images.cameras[0].width
    tangents = {
        Camera("SIMPLE_PINHOLE", w, w, (2.0 * w, w / 2, w / 2)): 0.25,
        Camera("SIMPLE_RADIAL_FISHEYE", w, w, (0.5 * w / 0.9, w / 2, w / 2, 0.0)): np.tan(0.9),
        Camera("SIMPLE_RADIAL_FISHEYE", w, w, (0.3 * w, w / 2, w / 2, 0.0)): 1.5,  # 95 degrees to each side
        # Slopes of 0.3 are seen at 0.3 (1 - 0.5 * 0.09) = 0.2865.
        Camera("SIMPLE_RADIAL", w, w, (w / 2 / 0.2865, w / 2, w / 2, -0.5)): 0.3,
    }
    halves = [half(camera) / tangent for camera, tangent in tangents.items()]
    np.testing.assert_allclose(halves, halves[0], rtol=1e-9)


def test_photos_that_show_surroundings_make_an_unbounded_frame(scene):
    dataset, images = scene
    frame = scene_frame(dataset.world_from_cam, replace(images, background=None, alpha=None), FRAME)
    assert frame.unbounded
    assert frame.background is None
    assert frame.far > 10 * frame.distance


def test_parallel_cameras_see_the_scene_ahead_of_them(scene):
    dataset, images = scene
    rows = np.tile(np.eye(4), (len(dataset), 1, 1))
    rows[:, :3, :3] = Rotation.from_euler("y", 30, degrees=True).as_matrix()
    rows[:, :3, 3] = rows[:, :3, 0] * np.arange(len(dataset))[:, None] + [4.0, 5.0, 6.0]
    frames = tuple(replace(f, world_from_cam=p) for f, p in zip(dataset.frames, rows, strict=True))
    parallel = replace(dataset, frames=frames)
    centre = scene_frame(parallel.world_from_cam, images, FRAME).unit_from_world.inverse().apply(np.zeros(3))
    in_cam = (centre - rows[:, :3, 3]) @ rows[0, :3, :3]
    assert (in_cam[:, 2] > 0).all()
    assert in_cam[:, 2].min() > np.ptp(rows[:, :3, 3], axis=0).max() / 2


def test_where_axes_do_not_meet_matches_tell_how_far_the_scene_is(scene):
    """Cameras in a row that look the same way, at points 20 times as far away as the row is long."""
    dataset, images = scene
    n = len(dataset)
    rows = np.tile(np.eye(4), (n, 1, 1))
    rows[:, 0, 3] = np.linspace(-2, 2, n)
    rng = np.random.default_rng(0)
    points = np.concatenate([rng.uniform(-2, 2, (200, 2)), rng.uniform(30, 50, (200, 1))], axis=1)
    a, b = np.zeros(200, dtype=np.int64), np.full(200, n - 1)
    focal, cx, cy = images.cameras[0].full().fx, images.cameras[0].full().cx, images.cameras[0].full().cy
    full = dataset.cameras[0].width / images.cameras[0].width
    seen = [focal * (points[:, :2] - rows[i, :2, 3]) / points[:, 2:] + [cx, cy] for i in (0, n - 1)]
    matches = Tracks.of_matches(np.stack([a, b], axis=1), full * np.stack(seen, axis=1))
    depth = matched_depth(dataset, rows, matches, FRAME)
    assert depth == pytest.approx(np.median(points[:, 2]), rel=0.02)
    frame = scene_frame(rows, images, FRAME, depth)
    assert frame.distance / frame.unit_from_world.scale == pytest.approx(depth)
    centre = frame.unit_from_world.inverse().apply(np.zeros(3))
    np.testing.assert_allclose(centre, [0, 0, depth], atol=1e-6)


def test_matches_that_contradict_the_poses_tell_no_depth(scene):
    dataset, _ = scene
    rng = np.random.default_rng(1)
    pairs = np.stack([np.zeros(100, dtype=np.int64), np.ones(100, dtype=np.int64)], axis=1)
    few = Tracks.of_matches(pairs[:20], rng.uniform(0, dataset.cameras[0].width, (20, 2, 2)))
    assert matched_depth(dataset, dataset.world_from_cam, few, FRAME) is None
    assert matched_depth(dataset, dataset.world_from_cam, None, FRAME) is None


def test_cameras_all_in_one_place_still_give_a_frame(scene):
    dataset, images = scene
    frames = tuple(replace(f, world_from_cam=dataset.frames[0].world_from_cam) for f in dataset.frames)
    frame = scene_frame(replace(dataset, frames=frames).world_from_cam, images, FRAME)
    assert np.isfinite(frame.distance)
    assert frame.unit_from_world.scale > 0


@pytest.mark.parametrize("noise", [0.0, 0.15, 0.35])
def test_a_small_thing_before_black_fills_the_box_also_where_poses_are_noisy(noise):
    """A cube of half a side 0.1, seen from a distance of 2 by cameras with a wide angle of view."""
    rng = np.random.default_rng(3)
    n, side, focal = 24, 120, 60.0
    camera = Camera("SIMPLE_PINHOLE", side, side, (focal, side / 2, side / 2))
    forward = rng.normal(size=(n, 3))
    forward /= np.linalg.norm(forward, axis=1, keepdims=True)
    right = np.cross(forward, [0.3, 0.5, 0.7])
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    poses = np.tile(np.eye(4), (n, 1, 1))
    poses[:, :3, :3] = np.stack([right, np.cross(forward, right), forward], axis=2)
    poses[:, :3, 3] = -2 * forward
    corners = np.array([[x, y, z] for x in (-0.1, 0.1) for y in (-0.1, 0.1) for z in (-0.1, 0.1)])
    pictures = np.zeros((n, side, side, 3), dtype=np.uint8)
    for pose, picture in zip(poses, pictures, strict=True):
        in_cam = (corners - pose[:3, 3]) @ pose[:3, :3]
        seen = focal * in_cam[:, :2] / in_cam[:, 2:] + side / 2
        (left, top), (end, bottom) = np.floor(seen.min(0)).astype(int), np.ceil(seen.max(0)).astype(int)
        picture[top:bottom, left:end] = 200
    size = np.full(n, side, dtype=np.int32)
    images = ImageSet(
        pictures.reshape(-1, 3),
        *(None, np.arange(n + 1) * side * side, size, size, (camera,) * n, np.zeros(3, dtype=np.float32)),
    )
    noisy = perturb_poses(poses, noise, seed=1)
    unit_from_world = scene_frame(noisy, images, FRAME).unit_from_world
    reached = np.abs(unit_from_world.apply(corners)).max()
    assert {0.0: 0.4, 0.15: 0.2, 0.35: 0.1}[noise] < reached < 1
    # The thing is in the middle of each photo: nearly all cameras, as they are given, see it within the box.
    to_middle = np.einsum(
        "nij,ni->nj", noisy[:, :3, :3], unit_from_world.inverse().apply(np.zeros(3)) - noisy[:, :3, 3]
    )
    assert (np.abs(to_middle[:, :2]).max(1) * unit_from_world.scale < 1).mean() >= 0.9
