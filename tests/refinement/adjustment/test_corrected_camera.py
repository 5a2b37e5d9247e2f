"""From a correction of ideal pixels back to the user's camera model."""

import numpy as np
import pytest
import torch

from biresnerf.geometry.camera.camera import Intrinsics, directions_in_cam, project
from biresnerf.geometry.camera.camera_models import MODEL_PARAMETERS, Camera
from biresnerf.refinement.adjustment.ideal import ideal_cameras
from biresnerf.refinement.adjustment.lens.corrected_camera import corrected_camera
from tests.refinement.adjustment import reference

CAMERAS = {
    "SIMPLE_PINHOLE": (500.0, 200.0, 150.0),
    "PINHOLE": (500.0, 510.0, 201.0, 149.0),
    "SIMPLE_RADIAL": (500.0, 200.0, 150.0, 0.05),
    "RADIAL": (500.0, 200.0, 150.0, 0.05, -0.02),
    "OPENCV": (500.0, 510.0, 201.0, 149.0, 0.05, -0.02, 0.001, -0.002),
    "FULL_OPENCV": (500.0, 510.0, 201.0, 149.0, 0.05, -0.02, 0.001, -0.002, 0.01, 0.02, -0.01, 0.01),
}


def correction(*, focal=0.0, k1=0.0, k2=0.0, x=0.0, y=0.0, p1=0.0, p2=0.0, aspect=0.0):
    return np.array([focal, k1, k2, x, y, p1, p2, aspect])


def largest_difference_px(camera, change):
    """Over the image, between the corrected camera and the camera behind its correction."""
    old, new = (Intrinsics.from_cameras([each]) for each in (camera, corrected_camera(camera, change)))
    ideal = ideal_cameras(old)
    x, y = np.meshgrid(np.linspace(0, 400, 21), np.linspace(0, 300, 16))
    xy = torch.from_numpy(np.stack([x, y], -1).reshape(-1, 2))
    image = torch.zeros(len(xy), dtype=torch.int64)
    ray = directions_in_cam(new, image, xy).numpy()
    slope = torch.from_numpy(ray[:, :2] / ray[:, 2:])
    row = torch.stack([ideal.fx, ideal.fy, ideal.cx, ideal.cy], 1)
    lens = reference.with_lens(row, torch.from_numpy(change)[None])
    pinhole = reference.in_pixels(lens, torch.cat([slope, torch.ones_like(slope[:, :1])], 1))
    shown = project(old, image, directions_in_cam(ideal, image, pinhole))
    return float((shown - xy).abs().max())


@pytest.mark.parametrize("model", CAMERAS)
def test_a_focal_length_is_corrected_exactly(model):
    camera = Camera(model, 400, 300, CAMERAS[model])
    assert largest_difference_px(camera, correction(focal=0.05)) < 1e-8


@pytest.mark.parametrize("model", ["SIMPLE_RADIAL", "RADIAL", "OPENCV"])
def test_distortion_is_corrected_exactly_where_there_was_none(model):
    values = [0.0 if abs(value) < 1 else value for value in CAMERAS[model]]
    found = correction(focal=-0.03, k1=0.04, k2=0.0 if model == "SIMPLE_RADIAL" else 0.02)
    assert largest_difference_px(Camera(model, 400, 300, tuple(values)), found) < 1e-8


@pytest.mark.parametrize("model", ["SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV"])
def test_distortion_is_corrected_to_a_twentieth_of_a_pixel_where_there_was_some(model):
    camera = Camera(model, 400, 300, CAMERAS[model])
    assert largest_difference_px(camera, correction(focal=0.02, k1=0.02)) < 0.05


@pytest.mark.parametrize("model", CAMERAS)
def test_a_camera_keeps_its_model(model):
    camera = Camera(model, 400, 300, CAMERAS[model])
    radial = {name: 0.01 for name in ("k1", "k2") if name in MODEL_PARAMETERS[model]}
    found = corrected_camera(camera, correction(focal=0.02, x=0.01, y=-0.02, **radial))
    assert (found.model, found.width, found.height) == (model, 400, 300)
    assert len(found.params) == len(camera.params)


@pytest.mark.parametrize("model", CAMERAS)
def test_a_principal_point_is_corrected_in_every_model_and_exactly_without_distortion(model):
    values = [0.0 if abs(value) < 1 else value for value in CAMERAS[model]]
    moved = correction(x=0.02, y=-0.015)
    assert largest_difference_px(Camera(model, 400, 300, tuple(values)), moved) < 1e-8
    assert largest_difference_px(Camera(model, 400, 300, CAMERAS[model]), moved) < 0.5


@pytest.mark.parametrize(
    ("model", "change", "grown"),
    [
        ("SIMPLE_PINHOLE", {"k1": 0.02}, "SIMPLE_RADIAL"),
        ("SIMPLE_RADIAL", {"k1": 0.02, "k2": 0.01}, "RADIAL"),
        ("SIMPLE_RADIAL", {"aspect": 0.01}, "OPENCV"),
        ("RADIAL", {"p1": 0.001, "p2": 0.002}, "OPENCV"),
        ("SIMPLE_PINHOLE", {"aspect": 0.01, "x": 0.01}, "PINHOLE"),
        ("PINHOLE", {"k1": 0.02, "p1": 0.001}, "OPENCV"),
    ],
)
def test_a_model_that_lacks_a_term_grows_to_the_smallest_that_has_it(model, change, grown):
    values = [0.0 if abs(value) < 1 else value for value in CAMERAS[model]]
    camera, moved = Camera(model, 400, 300, tuple(values)), correction(focal=0.01, **change)
    assert corrected_camera(camera, moved).model == grown
    assert largest_difference_px(camera, moved) < 1e-8


@pytest.mark.parametrize(
    ("model", "shape"),
    [("FOV", (0.9,)), ("DIVISION", (-0.2,)), ("EUCM", (0.6, 1.1))],
    ids=["FOV", "DIVISION", "EUCM"],
)
def test_a_lens_of_another_formula_is_corrected_and_stays_one(model, shape):
    """Its formula holds any change of the focal length, and nearly any small one of the shape."""
    camera = Camera(model, 400, 300, (300.0, 306.0, 201.0, 149.0, *shape))
    for change, px in ((correction(focal=0.05), 1e-4), (correction(focal=0.02, k1=0.01), 0.2)):
        assert corrected_camera(camera, change).model == model
        assert largest_difference_px(camera, change) < px
