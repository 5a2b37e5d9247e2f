"""Points of a result: triangulated from the refined cameras, compared with the truth; never stale."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from biresnerf.data.formats.colmap.read_model import read_colmap_model
from biresnerf.data.model.colmap_scene import NO_POINT, ColmapModel, ColmapPoints, no_points
from biresnerf.data.model.dataset import Dataset, Frame, SourceFormat
from biresnerf.data.model.refined_set import refined_set
from biresnerf.data.model.result_model import model_of_poses, with_points
from biresnerf.data.photos.images import ImageSet
from biresnerf.data.points.refined_points import (
    MOST_ERROR_PX,
    triangulated,
    with_given_points,
    with_points_of,
)
from biresnerf.data.points.tracks import Tracks
from biresnerf.geometry.camera.camera_models import MODEL_PARAMETERS, Camera
from biresnerf.geometry.camera.pixel_rays import pixels_of_points, rays_of_pixels
from biresnerf.geometry.rigid import rigid_inverse
from biresnerf.geometry.similarity import Similarity
from biresnerf.geometry.triangulation import parallax_deg, triangulate
from tests.data.formats.random_sets import random_camera, random_poses
from tests.data.test_real_sets import ROOT
from tests.refinement.tiny_scene import photos_set


def seen_model(
    seed: int,
    poses: np.ndarray,
    xyz: np.ndarray,
    *,
    model: str | None = None,
    noise_px: float = 0.0,
    camera: Camera | None = None,
) -> ColmapModel:
    """Cameras at ``poses`` with a feature of each point [m, 3], in another order in each image; all tracks complete."""
    rng = np.random.default_rng(seed)
    camera = camera or random_camera(rng, model, (640, 480))
    built = model_of_poses([f"{i}.jpg" for i in range(len(poses))], [camera], [0] * len(poses), poses)
    images, orders = {}, {}
    for number, pose in zip(built.images, rigid_inverse(poses), strict=True):
        orders[number] = rng.permutation(len(xyz))
        seen = pixels_of_points(camera.full(), xyz @ pose[:3, :3].T + pose[:3, 3])[orders[number]]
        seen = seen + rng.normal(0, noise_px, seen.shape) if noise_px else seen
        images[number] = replace(
            built.images[number], points2d_px=seen, point3d_ids=np.full(len(xyz), NO_POINT)
        )
    elements = np.array(
        [[n, np.flatnonzero(orders[n] == k)[0]] for k in range(len(xyz)) for n in images], np.int64
    )
    points = ColmapPoints(
        np.arange(len(xyz)) * 3 + 5, np.zeros((len(xyz), 3)), rng.integers(0, 256, (len(xyz), 3), dtype=np.uint8),
        np.full(len(xyz), -1.0), np.arange(len(xyz) + 1) * len(poses), elements[:, 0].copy(), elements[:, 1].copy(),
    )  # fmt: skip
    return with_points(replace(built, images=images), points)


@pytest.mark.parametrize("model", sorted(MODEL_PARAMETERS))
def test_rays_and_pixels_are_inverse_and_those_of_the_torch_camera(model):
    import torch

    from biresnerf.geometry.camera.camera import Intrinsics, directions_in_cam, project

    rng = np.random.default_rng(0)
    camera = random_camera(rng, model, (640, 480))
    xy = rng.uniform(0, 1, (200, 2)) * [640, 480]
    rays = rays_of_pixels(camera.full(), xy)
    np.testing.assert_allclose(pixels_of_points(camera.full(), 3.0 * rays), xy, atol=1e-8)
    lens, none = Intrinsics.from_cameras([camera]), torch.zeros(200, dtype=torch.int64)
    np.testing.assert_allclose(directions_in_cam(lens, none, torch.from_numpy(xy)).numpy(), rays, atol=1e-12)
    points = rays * rng.uniform(1, 9, (200, 1))
    np.testing.assert_allclose(
        project(lens, none, torch.from_numpy(points)).numpy(),
        pixels_of_points(camera.full(), points),
        atol=1e-9,
    )


def test_exact_rays_meet_in_their_points_wherever_the_origin_lies():
    rng = np.random.default_rng(1)
    far = np.array([4.5e5, -5.4e6, 1e3])
    xyz, centres = rng.normal(size=(30, 3)) + far, 5 * rng.normal(size=(8, 3)) + far
    point = np.repeat(np.arange(30), 4)
    origins = centres[rng.integers(0, 8, 120)]
    directions = (xyz[point] - origins) / np.linalg.norm(xyz[point] - origins, axis=1, keepdims=True)
    found = triangulate(origins, directions, np.full(120, 500.0), point, 30)
    wide = parallax_deg(origins, found, point) > 2
    assert wide.sum() > 25
    np.testing.assert_allclose(found[wide], xyz[wide], atol=1e-6)


@pytest.mark.parametrize("model", ["SIMPLE_RADIAL", "OPENCV", "OPENCV_FISHEYE"])
def test_tracks_are_triangulated_where_the_refined_cameras_see_them(model):
    rng = np.random.default_rng(2)
    poses, xyz = random_poses(rng, 6), rng.uniform(-0.6, 0.6, (40, 3))
    tracks = seen_model(3, poses, xyz, model=model)
    # The same features, cameras elsewhere: points go where the cameras now see them.
    carry = Similarity(0.7, random_poses(rng, 1)[0, :3, :3], np.array([5.0, 2.0, -9.0]))
    moved = model_of_poses(
        [f"{i}.jpg" for i in range(6)], list(tracks.cameras.values()), [0] * 6, carry.apply_to_poses(poses)
    )
    images = {
        n: replace(image, cam_from_world=moved.images[n].cam_from_world) for n, image in tracks.images.items()
    }
    found = triangulated(replace(tracks, images=images), tracks.points)
    assert found.ids.tolist() == tracks.points.ids.tolist()
    np.testing.assert_allclose(found.xyz, carry.apply(xyz), atol=1e-7)
    assert found.errors.max() < 1e-6
    np.testing.assert_array_equal(found.rgb, tracks.points.rgb)


def test_noise_in_features_leaves_points_as_close_as_bundle_theory_lets_them_be():
    rng = np.random.default_rng(4)
    poses, xyz = random_poses(rng, 12), rng.uniform(-0.6, 0.6, (60, 3))
    found = triangulated(model := seen_model(5, poses, xyz, model="PINHOLE", noise_px=0.5), model.points)
    off = np.linalg.norm(found.xyz - xyz, axis=1)
    # 0.5 px at 4 units and some 700 px of focal length is 0.003 across; twelve views average it.
    assert np.median(off) < 0.002
    assert 0.4 < np.mean(found.errors) < 0.8


def test_wrong_matches_are_left_out_and_points_that_nothing_agrees_on():
    rng = np.random.default_rng(6)
    poses, xyz = random_poses(rng, 8), rng.uniform(-0.6, 0.6, (30, 3))
    model = seen_model(7, poses, xyz, model="PINHOLE")
    points = model.points
    images = dict(model.images)
    # Point 0 is matched wrongly in one image, point 1 in all.
    for k, rows in ((0, [0]), (1, range(8))):
        for row in rows:
            element = points.track_starts[k] + row
            image, feature = int(points.track_image_ids[element]), int(points.track_point2d_indices[element])
            xy = images[image].points2d_px.copy()
            xy[feature] += rng.choice([-1, 1], 2) * rng.uniform(60, 90, 2)
            images[image] = replace(images[image], points2d_px=xy)
    found = triangulated(replace(model, images=images), points)
    assert points.ids[1] not in found.ids
    assert len(found) == 29
    np.testing.assert_allclose(found.xyz[0], xyz[0], atol=1e-6)
    assert found.track_starts[1] == 7
    assert found.errors.max() < MOST_ERROR_PX


def test_points_seen_from_one_place_only_are_left_out():
    rng = np.random.default_rng(8)
    poses = np.repeat(random_poses(rng, 1), 3, axis=0)
    poses[:, :3, 3] += rng.normal(0, 1e-3, (3, 3))
    model = seen_model(9, poses, rng.uniform(-0.5, 0.5, (10, 3)), model="PINHOLE")
    assert len(triangulated(model, model.points)) == 0


def dataset_of(model: ColmapModel, poses: np.ndarray) -> Dataset:
    frames = tuple(
        Frame(image.name, Path("/none") / image.name, 0, pose, "given")
        for image, pose in zip(model.images.values(), poses, strict=True)
    )
    source = SourceFormat("images", None, {}, np.eye(4), colmap=model)
    return Dataset(Path("/none"), tuple(model.cameras.values()), frames, source)


def test_points_are_the_given_ones_only_where_nothing_moved():
    rng = np.random.default_rng(10)
    poses, xyz = random_poses(rng, 6), rng.uniform(-0.6, 0.6, (20, 3))
    model = seen_model(11, poses, xyz, model="PINHOLE")
    model = with_points(model, replace(model.points, xyz=xyz))
    dataset = dataset_of(model, poses)
    same = with_given_points(refined_set(dataset, poses), model)
    assert same.points_source == "given"
    assert np.array_equal(same.model.points.xyz, xyz)
    other = poses.copy()
    other[2, 0, 3] += 1e-3
    again = with_given_points(refined_set(dataset, other), model)
    assert again.points_source == "tracks"
    assert not np.array_equal(again.model.points.xyz, xyz)


def test_points_without_tracks_go_with_the_cameras_near_them():
    rng = np.random.default_rng(12)
    poses, xyz = random_poses(rng, 6), rng.uniform(-0.6, 0.6, (20, 3))
    model = seen_model(13, poses, xyz, model="PINHOLE")
    bare = replace(
        model.points, xyz=xyz, track_starts=np.zeros(21, np.int64),
        track_image_ids=np.zeros(0, np.int64), track_point2d_indices=np.zeros(0, np.int64),
    )  # fmt: skip
    model = with_points(model, bare)
    motion = Similarity(1.0, random_poses(rng, 1)[0, :3, :3], np.array([1.0, 2.0, 3.0]))
    moved = with_given_points(refined_set(dataset_of(model, poses), motion.apply_to_poses(poses)), model)
    assert moved.points_source == "moved"
    np.testing.assert_allclose(moved.model.points.xyz, motion.apply(xyz), atol=1e-9)


def pairwise(model: ColmapModel, rng: np.random.Generator, wrong: int = 0) -> Tracks:
    """Every pair of images whose features see one point, matched; some go astray."""
    order = {number: row for row, number in enumerate(model.images)}
    found = []
    for k in range(len(model.points)):
        track = slice(model.points.track_starts[k], model.points.track_starts[k + 1])
        seen = [
            (order[int(i)], model.images[int(i)].points2d_px[f])
            for i, f in zip(
                model.points.track_image_ids[track], model.points.track_point2d_indices[track], strict=True
            )
        ]
        found += [(a, b) for one, a in enumerate(seen) for b in seen[one + 1 :]]
    found = [found[i] for i in rng.permutation(len(found))]
    for i in range(wrong):
        (a, xy), (b, _) = found[i]
        found[i] = ((a, xy), (b, found[i + 50][1][1] + 31.0))
    images = np.array([[a[0], b[0]] for a, b in found])
    return Tracks.of_matches(images, np.array([[a[1], b[1]] for a, b in found]))


def photos_like(model: ColmapModel, colours: np.ndarray) -> ImageSet:
    """Photos at half size in which each point's pixel has its colour."""
    pictures = []
    for image in model.images.values():
        picture = np.zeros((240, 320, 3), np.uint8)
        at = np.clip((image.points2d_px / 2).astype(int), 0, [319, 239])
        rows = np.searchsorted(np.sort(model.points.ids), image.point3d_ids)
        picture[at[:, 1], at[:, 0]] = colours[rows]
        pictures.append(picture)
    return photos_set(pictures)


def test_feature_matches_become_the_points_that_their_rays_meet_in():
    rng = np.random.default_rng(14)
    poses, xyz = random_poses(rng, 6), rng.uniform(-0.6, 0.6, (40, 3))
    model = seen_model(15, poses, xyz, model="SIMPLE_RADIAL")
    tracks = pairwise(model, rng, wrong=5)
    dataset = dataset_of(replace(model), poses)
    bare = refined_set(replace(dataset, source=replace(dataset.source, colmap=None)), poses)
    images = photos_like(model, model.points.rgb)
    result = with_points_of(bare, None, tracks, images)
    assert result.points_source == "features"
    found = result.model.points
    assert 35 <= len(found) <= 45
    off = np.linalg.norm(found.xyz[:, None] - xyz[None], axis=2).min(1)
    assert np.median(off) < 1e-6
    assert off.max() < 0.02
    nearest = np.linalg.norm(found.xyz[:, None] - xyz[None], axis=2).argmin(1)
    assert np.median(np.abs(found.rgb.astype(int) - model.points.rgb[nearest]).max(1)) <= 40
    for image in result.model.images.values():  # every feature says which point it is of
        assert (image.point3d_ids >= 0).sum() == (found.track_image_ids == image.id).sum()


def test_the_inputs_own_tracks_go_before_matches_and_nothing_comes_of_nothing():
    rng = np.random.default_rng(16)
    poses, xyz = random_poses(rng, 5), rng.uniform(-0.6, 0.6, (20, 3))
    model = seen_model(17, poses, xyz, model="PINHOLE")
    dataset, images = dataset_of(model, poses), photos_like(model, model.points.rgb)
    bare = refined_set(dataset, poses + 1e-9)
    assert with_points_of(bare, model, pairwise(model, rng), images).points_source == "tracks"
    empty = with_points(model, no_points())
    assert with_points_of(bare, empty, pairwise(model, rng), images).points_source == "features"
    assert with_points_of(bare, empty, None, images).points_source == "none"


@pytest.mark.parametrize("path", ["kitchen25/sparse/0", "colmap_maupertuis/sparse_txt"])
def test_a_models_own_poses_give_its_own_points_back(path):
    if not (ROOT / path).is_dir():
        pytest.skip(f"no model {path}: set BIRESNERF_TEST_DATA to the folder that holds it")
    model = read_colmap_model(ROOT / path)
    found = triangulated(model, model.points)
    assert len(found) > 0.99 * len(model.points)
    rows = np.searchsorted(np.sort(model.points.ids), found.ids)
    rows = np.argsort(model.points.ids)[rows]
    assert found.errors.mean() < 1.02 * model.points.errors[rows].mean()
    size = np.linalg.norm(model.points.xyz - model.points.xyz.mean(0), axis=1).mean()
    assert np.median(np.linalg.norm(found.xyz - model.points.xyz[rows], axis=1)) < 1e-3 * size
