"""transforms.json changed at random: a sound dataset, or a complete error."""

from __future__ import annotations

import copy
import json

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from biresnerf.data.formats.read_dataset import read_dataset
from biresnerf.data.model.dataset import Dataset
from biresnerf.errors import InputError
from tests.data.scenes import (
    assert_complete,
    blender_scene,
    nerfstudio_scene,
    save,
)

anything = st.recursive(
    st.none()
    | st.booleans()
    | st.integers()
    | st.floats()
    | st.sampled_from(
        [
            "",
            "OPENCV",
            "OPENCV_FISHEYE",
            "FULL_OPENCV",
            "images/000.jpg",
            "..",
            "\0",
            "x" * 300,
            1e308,
            -1,
            0,
            1e-300,
        ]
    ),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=5), inner, max_size=3),
    max_leaves=6,
)
KNOWN_KEYS = (
    *("w", "h", "fl_x", "fl_y", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "k4", "x_fov", "camera_angle_x"),
    *("camera_angle_y", "camera_model", "applied_transform", "applied_scale", "is_fisheye", "mask_path"),
    *("k5", "k6", "equirectangular"),
    *("rolling_shutter", "frames", "file_path", "transform_matrix", "aabb_scale", "ftheta_p0"),
)


def places(value, found):
    """Every list and object inside a document."""
    if isinstance(value, dict | list):
        found.append(value)
        for item in value.values() if isinstance(value, dict) else value:
            places(item, found)
    return found


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    folder = tmp_path_factory.mktemp("scene")
    return folder, nerfstudio_scene(folder), blender_scene(folder)


@settings(max_examples=400, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(st.data())
def test_any_document_gives_a_dataset_or_a_complete_error(scene, data):
    folder, *documents = scene
    document = copy.deepcopy(data.draw(st.sampled_from(documents)))
    for _ in range(data.draw(st.integers(1, 3))):
        place = data.draw(st.sampled_from(places(document, [])))
        key = data.draw(
            st.sampled_from(KNOWN_KEYS) if isinstance(place, dict) else st.integers(0, max(0, len(place) - 1))
        )
        if isinstance(place, dict) or place:
            place[key] = data.draw(anything)
    try:
        dataset = read_dataset(save(folder, document))
    except InputError as error:
        assert_complete(error, error.code)
    else:
        check_sound(dataset)


def check_sound(dataset: Dataset) -> None:
    """What everything after the reader relies on."""
    assert len(dataset) >= 3
    given = [frame.world_from_cam for frame in dataset.frames if frame.world_from_cam is not None]
    poses = np.reshape(given, (-1, 4, 4))
    assert np.isfinite(poses).all()
    turned = poses[:, :3, :3] @ poses[:, :3, :3].swapaxes(1, 2)
    np.testing.assert_allclose(turned, np.broadcast_to(np.eye(3), turned.shape), atol=1e-12)
    for camera in dataset.cameras:
        full = camera.full()
        assert np.isfinite(full).all()
        assert full.fx > 0
        assert full.fy > 0
        assert camera.width > 0
        assert camera.height > 0
    json.dumps(dataset.source.document, allow_nan=False)
