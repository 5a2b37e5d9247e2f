"""The synthetic scene: exact truth, read back through the reader, and geometry checked point by point."""

from __future__ import annotations

import numpy as np
import pytest
from PIL import Image

from biresnerf.data.formats.read_dataset import read_dataset
from biresnerf.data.photos.images import load_images
from biresnerf.data.synthetic.scene import (
    SHAPES,
    render_synthetic,
    synthetic_cameras,
    synthetic_focal,
    write_synthetic_scene,
)
from biresnerf.data.synthetic.shapes import Shape


def signed_distance(shape: Shape, points: np.ndarray) -> np.ndarray:
    """Distance to the surface (negative inside), by the shapes' textbook formulas in float64."""
    local = (points - np.array(shape.centre)) @ shape.world_from_shape.astype(np.float64)
    size = np.array(shape.size)
    if shape.kind == "sphere":
        return np.linalg.norm(local, axis=1) - size[0]
    if shape.kind == "box":
        q = np.abs(local) - size
    else:
        q = np.stack([np.hypot(local[:, 0], local[:, 1]) - size[0], np.abs(local[:, 2]) - size[2]], axis=1)
    return np.linalg.norm(np.maximum(q, 0), axis=1) + np.minimum(q.max(axis=1), 0)


def points_of_depth(pose: np.ndarray, depth: np.ndarray) -> np.ndarray:
    """World points [n, 3] of the pixels with depth."""
    size = len(depth)
    y, x = np.nonzero(np.isfinite(depth))
    z = depth[y, x].astype(np.float64)
    focal = synthetic_focal(size)
    in_cam = np.stack([(x + 0.5 - size / 2) / focal * z, (y + 0.5 - size / 2) / focal * z, z], axis=1)
    return in_cam @ pose[:3, :3].T + pose[:3, 3]


def test_depth_lies_on_the_union_of_the_shapes():
    for pose in synthetic_cameras(5, seed=3):
        depth = render_synthetic(pose, 48, seed=3)[1]
        points = points_of_depth(pose, depth)
        distances = np.stack([signed_distance(shape, points) for shape in SHAPES]).min(axis=0)
        assert len(points) > 300
        assert np.abs(distances).max() < 2e-5


def test_nothing_stands_before_the_depth():
    pose = synthetic_cameras(6, seed=0)[2]
    depth = render_synthetic(pose, 40, seed=0)[1]
    depth = np.where(np.isfinite(depth), depth, 8.0)
    for share in np.linspace(0.3, 0.995, 60):
        points = points_of_depth(pose, share * depth)
        assert min(signed_distance(shape, points).min() for shape in SHAPES) > -1e-4


def test_a_point_has_one_colour_in_all_views():
    one, two = synthetic_cameras(40, seed=1)[[20, 21]]
    two = one.copy()
    # A second camera a little to the side sees nearly all of the same points.
    turn = np.radians(3.0)
    about_z = np.array([[np.cos(turn), -np.sin(turn), 0], [np.sin(turn), np.cos(turn), 0], [0, 0, 1]])
    two[:3] = about_z @ one[:3]
    size = 192
    (colour_one, depth_one), (colour_two, depth_two) = (render_synthetic(p, size, 1) for p in (one, two))
    y, x = np.nonzero(np.isfinite(depth_one))
    points = points_of_depth(one, depth_one)
    in_two = (points - two[:3, 3]) @ two[:3, :3]
    u, v = (synthetic_focal(size) * in_two[:, :2] / in_two[:, 2:] + size / 2).T
    column, row = u.astype(int), v.astype(int)
    visible = np.abs(depth_two[row, column] - in_two[:, 2]) < 0.01
    difference = np.abs(
        colour_one[y, x, :3].astype(float)[visible] - colour_two[row, column, :3].astype(float)[visible]
    )
    assert visible.mean() > 0.7
    assert np.median(difference) < 8.0


def test_written_scene_reads_back_with_exact_poses(tmp_path):
    path = write_synthetic_scene(tmp_path, n_views=6, size=32, seed=7)
    dataset = read_dataset(path)
    assert dataset.source.dialect == "blender"
    assert dataset.names == tuple(f"./train/r_{i}" for i in range(6))
    np.testing.assert_allclose(dataset.world_from_cam, synthetic_cameras(6, 7), atol=1e-12)
    assert dataset.cameras[0].full().fx == pytest.approx(synthetic_focal(32), rel=1e-12)
    images = load_images(dataset)
    assert images.background is not None
    assert images.background.tolist() == [1, 1, 1]
    assert images.alpha is not None
    stored = np.asarray(Image.open(tmp_path / "train" / "r_2.png"))
    assert np.array_equal(stored, render_synthetic(dataset.world_from_cam[2], 32, 7)[0])


def test_every_view_is_rich_in_texture_and_unlike_every_other():
    views = [render_synthetic(pose, 40, 2)[0].astype(float) for pose in synthetic_cameras(16, 2)]
    for view in views:
        assert (view[..., 3] > 128).mean() > 0.15
        seen = view[view[..., 3] > 250][:, :3]
        assert seen.std(axis=0).min() > 20
    alike = [np.abs(a - b).mean() for i, a in enumerate(views) for b in views[:i]]
    assert min(alike) > 10
