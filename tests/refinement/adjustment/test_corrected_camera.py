"""From a correction of ideal pixels back to the user's camera model."""

import numpy as np
import pytest
import torch

from biresnerf.geometry.camera.camera import Intrinsics, directions_in_cam, project
from biresnerf.geometry.camera.camera_models import Camera
from biresnerf.refinement.adjustment.ideal import ideal_cameras
from biresnerf.refinement.adjustment.lens.corrected_camera import corrected_camera

CAMERAS = {
    "SIMPLE_PINHOLE": (500.0, 200.0, 150.0),
    "PINHOLE": (500.0, 510.0, 201.0, 149.0),
    "SIMPLE_RADIAL": (500.0, 200.0, 150.0, 0.05),
    "RADIAL": (500.0, 200.0, 150.0, 0.05, -0.02),
    "OPENCV": (500.0, 510.0, 201.0, 149.0, 0.05, -0.02, 0.001, -0.002),
    "FULL_OPENCV": (500.0, 510.0, 201.0, 149.0, 0.05, -0.02, 0.001, -0.002, 0.01, 0.02, -0.01, 0.01),
}


def largest_difference_px(camera, correction):
    """Over the image, between the corrected camera and the camera behind its correction."""
    old, new = (Intrinsics.from_cameras([each]) for each in (camera, corrected_camera(camera, correction)))
    ideal = ideal_cameras(old)
    x, y = np.meshgrid(np.linspace(0, 400, 21), np.linspace(0, 300, 16))
    xy = torch.from_numpy(np.stack([x, y], -1).reshape(-1, 2))
    image = torch.zeros(len(xy), dtype=torch.int64)
    ray = directions_in_cam(new, image, xy).numpy()
    slope = ray[:, :2] / ray[:, 2:]
    s = (slope**2).sum(1, keepdims=True)
    bent = np.exp(correction[0]) * (1 + correction[1] * s + correction[2] * s**2) * slope
    pinhole = project(ideal, image, torch.from_numpy(np.concatenate([bent, np.ones_like(s)], 1)))
    shown = project(old, image, directions_in_cam(ideal, image, pinhole))
    return float((shown - xy).abs().max())


@pytest.mark.parametrize("model", CAMERAS)
def test_a_focal_length_is_corrected_exactly(model):
    camera = Camera(model, 400, 300, CAMERAS[model])
    assert largest_difference_px(camera, np.array([0.05, 0.0, 0.0])) < 1e-8


@pytest.mark.parametrize("model", ["SIMPLE_RADIAL", "RADIAL", "OPENCV"])
def test_distortion_is_corrected_exactly_where_there_was_none(model):
    values = [0.0 if abs(value) < 1 else value for value in CAMERAS[model]]
    correction = np.array([-0.03, 0.04, 0.0 if model == "SIMPLE_RADIAL" else 0.02])
    assert largest_difference_px(Camera(model, 400, 300, tuple(values)), correction) < 1e-8


@pytest.mark.parametrize("model", ["SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV"])
def test_distortion_is_corrected_to_a_twentieth_of_a_pixel_where_there_was_some(model):
    camera = Camera(model, 400, 300, CAMERAS[model])
    assert largest_difference_px(camera, np.array([0.02, 0.02, 0.0])) < 0.05


@pytest.mark.parametrize("model", CAMERAS)
def test_a_camera_keeps_its_model(model):
    camera = Camera(model, 400, 300, CAMERAS[model])
    found = corrected_camera(camera, np.array([0.02, 0.01, 0.01]))
    assert (found.model, found.width, found.height) == (model, 400, 300)
    assert len(found.params) == len(camera.params)
