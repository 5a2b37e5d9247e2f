"""points.ply, read by the rules of PLY: every point with its colour, at any distance; and the field's points."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from biresnerf.data.formats.simple.points_ply import write_points_ply
from biresnerf.data.model.colmap_scene import no_points
from biresnerf.data.model.result_model import with_points
from biresnerf.data.points.refined_points import FieldPoints, with_field_points
from biresnerf.errors import InputError
from tests.data.formats.random_sets import random_result
from tests.data.scenes import assert_complete

TYPES = {"double": "<f8", "float": "<f4", "uchar": "u1"}


def ply_vertices(path):
    """The vertices of a binary PLY file by its own header (Turk 1994): one element, scalar properties."""
    head, body = path.read_bytes().split(b"end_header\n", 1)
    magic, form, element, *properties = head.decode("ascii").splitlines()
    assert (magic, form) == ("ply", "format binary_little_endian 1.0")
    word, name, count = element.split()
    assert (word, name) == ("element", "vertex")
    kinds = [line.split() for line in properties]
    assert all(word == "property" for word, _, _ in kinds)
    dtype = np.dtype([(name, TYPES[kind]) for _, kind, name in kinds])
    assert len(body) == int(count) * dtype.itemsize
    return np.frombuffer(body, dtype)


def columns(vertices, *names):
    return np.stack([vertices[name] for name in names], 1)


def test_points_keep_every_digit_and_their_colours(tmp_path):
    refined = random_result(2)
    away = np.array([4.5e5, 5.4e6, 120.0])
    far = replace(refined.model.points, xyz=refined.model.points.xyz + away)
    write_points_ply(replace(refined, model=with_points(refined.model, far)), tmp_path / "points.ply")
    vertices = ply_vertices(tmp_path / "points.ply")
    np.testing.assert_array_equal(columns(vertices, "x", "y", "z"), far.xyz)
    np.testing.assert_array_equal(columns(vertices, "red", "green", "blue"), far.rgb)
    assert not columns(vertices, "nx", "ny", "nz").any()


def test_a_set_without_points_is_refused(tmp_path):
    refined = random_result(2)
    with pytest.raises(InputError) as caught:
        write_points_ply(
            replace(refined, model=with_points(refined.model, no_points())), tmp_path / "points.ply"
        )
    assert_complete(caught.value, "export_not_possible", "points.ply")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("moved", [False, True])
def test_points_of_the_field_go_where_its_cameras_went(moved):
    refined = random_result(3)
    bare = replace(refined, model=with_points(refined.model, no_points()), points_source="none")
    rng = np.random.default_rng(0)
    xyz, rgb = rng.normal(size=(500, 3)), rng.integers(0, 256, (500, 3), dtype=np.uint8)
    motion = refined.world_from_cam[0] if moved else np.eye(4)
    with_field = with_field_points(bare, FieldPoints(xyz, rgb, np.linalg.inv(motion) @ bare.world_from_cam))
    assert with_field.points_source == "field"
    points = with_field.model.points
    np.testing.assert_allclose(points.xyz, xyz @ motion[:3, :3].T + motion[:3, 3], atol=1e-9)
    np.testing.assert_array_equal(points.rgb, rgb)
    assert len(points.track_image_ids) == 0
    assert np.diff(points.track_starts).max() == 0
    nothing = with_field_points(bare, FieldPoints(xyz[:0], rgb[:0], bare.world_from_cam))
    assert nothing.points_source == "none"
