"""How far the scene moves in photos between two sets of poses."""

from __future__ import annotations

import numpy as np
import pytest

from biresnerf.refinement.views.compare_rigs import Rig, moved_px
from tests.refinement.tiny_scene import tiny_set

VIEWS = 14


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return tiny_set(tmp_path_factory.mktemp("scene"), views=VIEWS, size=24)


def test_motion_in_the_image_is_that_of_a_turned_camera(scene):
    dataset, images = scene
    cameras = tuple(dataset.camera_of(i) for i in range(VIEWS))
    turned = dataset.world_from_cam.copy()
    angle = 0.02
    about_y = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])
    turned[:, :3, :3] = turned[:, :3, :3] @ about_y
    moved = moved_px(Rig(dataset.world_from_cam, cameras), Rig(turned, cameras), images)
    assert moved == pytest.approx(angle * images.cameras[0].full().fx, rel=0.1)
