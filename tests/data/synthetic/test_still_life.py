"""The still life: exact surfaces, one colour per point in all views, and shadows where something blocks the light."""

from __future__ import annotations

import numpy as np
import pytest

from biresnerf.data.synthetic.scene import render_shapes, synthetic_cameras, synthetic_focal
from biresnerf.data.synthetic.still_life import STILL_LIFE, Light, Surface, _meets, still_life_surfaces
from tests.data.synthetic.test_scene import points_of_depth, signed_distance


@pytest.fixture(scope="module")
def surfaces() -> list[Surface]:
    return still_life_surfaces()


def test_depth_lies_on_the_surfaces(surfaces):
    for pose in synthetic_cameras(4, seed=3):
        depth = render_shapes(STILL_LIFE, surfaces, pose, 48, 48, synthetic_focal(48))[1]
        points = points_of_depth(pose, depth)
        assert len(points) > 300
        assert np.abs(np.stack([signed_distance(s, points) for s in STILL_LIFE]).min(axis=0)).max() < 2e-5


def test_a_point_has_one_colour_in_all_views(surfaces):
    one = synthetic_cameras(40, seed=1)[20]
    turn = np.radians(3.0)
    about_z = np.array([[np.cos(turn), -np.sin(turn), 0], [np.sin(turn), np.cos(turn), 0], [0, 0, 1]])
    two = one.copy()
    two[:3] = about_z @ one[:3]
    size = 160
    views = [
        render_shapes(STILL_LIFE, surfaces, pose, size, size, synthetic_focal(size)) for pose in (one, two)
    ]
    (colour_one, depth_one), (colour_two, depth_two) = views
    y, x = np.nonzero(np.isfinite(depth_one))
    in_two = (points_of_depth(one, depth_one) - two[:3, 3]) @ two[:3, :3]
    column, row = (synthetic_focal(size) * in_two[:, :2] / in_two[:, 2:] + size / 2).T.astype(int)
    visible = np.abs(depth_two[row, column] - in_two[:, 2]) < 0.01
    difference = np.abs(colour_one[y, x, :3].astype(float) - colour_two[row, column, :3])[visible]
    assert visible.mean() > 0.7
    assert np.median(difference) < 6


def test_rays_to_the_lamp_meet_what_rays_of_a_camera_meet():
    rng = np.random.default_rng(5)
    points = rng.uniform(-1.5, 1.5, (300, 3)).astype(np.float32)
    for shape in STILL_LIFE:
        outside = points[signed_distance(shape, points) > 1e-3]
        for ray in rng.normal(size=(4, 3)).astype(np.float32):
            ray /= np.linalg.norm(ray)
            seen = [shape.intersect(point, ray[None]).distance[0] < 1e6 for point in outside]
            assert np.mean(_meets(shape, outside, ray) == seen) > 0.995  # but for rays that graze


def test_there_is_shade_beneath_the_table_and_light_above_it():
    light = Light(STILL_LIFE)
    up = np.array([[0, 0, 1.0]], np.float32)
    open_air, beneath = (light.at(np.array([[0.8, -0.6, z]], np.float32), up)[0] for z in (0.5, -0.62))
    assert open_air > 0.9
    assert beneath < 0.3 * open_air


def test_its_colours_are_those_of_things_not_of_noise(surfaces):
    """What a field learns first is a set's mean colour at a place: on rainbow noise it is grey."""
    pose = synthetic_cameras(3, seed=0)[1]
    picture = render_shapes(STILL_LIFE, surfaces, pose, 96, 96, synthetic_focal(96))[0].astype(float)
    blocks = picture.reshape(12, 8, 12, 8, 4).mean(axis=(1, 3))
    within = blocks[blocks[..., 3] > 254][:, :3]
    assert np.median(np.ptp(within, axis=1)) > 25
