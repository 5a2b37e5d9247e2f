"""Cameras: against pycolmap's, round trips, and COLMAP's parameter orders."""

from __future__ import annotations

import importlib.util
import json
import subprocess
import sys

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from biresnerf.data.dataset import Camera
from biresnerf.geometry.camera import Intrinsics, directions_in_cam, project
from biresnerf.geometry.camera_models import (
    MODEL_PARAMETERS,
    OpenCVParameters,
    full_parameters,
    smallest_model,
)
from biresnerf.geometry.lens import lens_problem

WIDTH, HEIGHT = 640, 480

CAMERAS = {
    "SIMPLE_PINHOLE": (500.0, 320.0, 240.0),
    "PINHOLE": (500.0, 510.0, 321.0, 238.5),
    "SIMPLE_RADIAL": (500.0, 320.0, 240.0, -0.12),
    "RADIAL": (480.0, 318.0, 243.0, 0.08, -0.03),
    "OPENCV": (500.0, 505.0, 322.0, 236.0, -0.15, 0.04, 0.002, -0.0015),
}

# zlib first: pycolmap's wheels carry their own, and Python's must be bound before (double free otherwise).
PYCOLMAP = """
import zlib, json, sys
import numpy as np, pycolmap
request = json.load(sys.stdin)
camera = pycolmap.Camera(model=request["model"], width=request["width"], height=request["height"],
                         params=request["params"])
pixels = np.array(request["pixels"])
rays = camera.cam_from_img(pixels)
points = np.array(request["points"])
pixels = np.asarray(camera.img_from_cam(points))
json.dump({"rays": np.asarray(rays).tolist(), "pixels": pixels.tolist()}, sys.stdout)
"""


def ask_pycolmap(model, params, pixels, points):
    """COLMAP's own undistortion of pixels and projection of points, from a process of its own."""
    if importlib.util.find_spec("pycolmap") is None:
        pytest.skip("pycolmap is not installed")
    request = {"model": model, "width": WIDTH, "height": HEIGHT, "params": params}
    request |= {"pixels": pixels.tolist(), "points": points.tolist()}
    answer = subprocess.run(
        [sys.executable, "-c", PYCOLMAP],
        input=json.dumps(request),
        capture_output=True,
        text=True,
        timeout=60,
        check=True,
    )
    return {key: np.array(value) for key, value in json.loads(answer.stdout).items()}


def one_camera(model: str, params: tuple[float, ...]) -> Intrinsics:
    return Intrinsics.from_cameras([Camera(model, WIDTH, HEIGHT, params)])


def pixels_everywhere(count: int = 200) -> np.ndarray:
    return np.random.default_rng(0).uniform(0, 1, (count, 2)) * (WIDTH, HEIGHT)


@pytest.mark.parametrize("model", CAMERAS)
def test_directions_and_projection_agree_with_colmap(model):
    pixels = pixels_everywhere()
    rng = np.random.default_rng(1)
    points = np.concatenate([rng.uniform(-0.4, 0.4, (200, 2)), np.ones((200, 1))], axis=1) * rng.uniform(
        1, 9, (200, 1)
    )
    theirs = ask_pycolmap(model, CAMERAS[model], pixels, points)
    intrinsics, index = one_camera(model, CAMERAS[model]), torch.zeros(200, dtype=torch.int64)
    directions = directions_in_cam(intrinsics, index, torch.from_numpy(pixels)).numpy()
    np.testing.assert_allclose(directions[:, :2] / directions[:, 2:], theirs["rays"][:, :2], atol=1e-7)
    ours = project(intrinsics, index, torch.from_numpy(points)).numpy()
    np.testing.assert_allclose(ours, theirs["pixels"], atol=1e-8)


small = st.floats(-1.0, 1.0, allow_nan=False)


@settings(max_examples=200, deadline=None)
@given(small, small, small, small, st.floats(0.5, 4.0), st.floats(0.8, 1.25))
def test_projection_inverts_directions_within_a_millionth_of_a_pixel(k1, k2, p1, p2, zoom, aspect):
    full = OpenCVParameters(
        zoom * WIDTH, zoom * WIDTH * aspect, 330.0, 250.0, 3 * k1, 3 * k2, 0.1 * p1, 0.1 * p2
    )
    if lens_problem(full, WIDTH, HEIGHT) is not None:
        return
    intrinsics = one_camera("OPENCV", tuple(full))
    pixels = torch.from_numpy(pixels_everywhere(64))
    index = torch.zeros(64, dtype=torch.int64)
    directions = directions_in_cam(intrinsics, index, pixels)
    torch.testing.assert_close(directions.norm(dim=1), torch.ones(64, dtype=torch.float64))
    assert (project(intrinsics, index, 7.0 * directions) - pixels).abs().max() < 1e-6


def test_each_ray_takes_its_own_images_camera():
    cameras = [Camera(model, WIDTH, HEIGHT, params) for model, params in CAMERAS.items()]
    together = Intrinsics.from_cameras(cameras)
    index = torch.arange(5).repeat(40)
    pixels = torch.from_numpy(pixels_everywhere())
    mixed = directions_in_cam(together, index, pixels)
    for number, camera in enumerate(cameras):
        rows = index == number
        alone = directions_in_cam(
            Intrinsics.from_cameras([camera]), torch.zeros(int(rows.sum()), dtype=torch.int64), pixels[rows]
        )
        torch.testing.assert_close(mixed[rows], alone, atol=1e-14, rtol=0)


def test_the_principal_point_looks_straight_ahead_and_x_grows_to_the_right():
    intrinsics = one_camera("PINHOLE", (500.0, 500.0, 320.0, 240.0))
    pixels = torch.tensor([[320.0, 240.0], [820.0, 240.0], [320.0, 740.0]])
    directions = directions_in_cam(intrinsics, torch.zeros(3, dtype=torch.int64), pixels)
    half = 0.5**0.5
    assert directions.dtype == torch.float32
    torch.testing.assert_close(directions, torch.tensor([[0, 0, 1.0], [half, 0, half], [0, half, half]]))


def test_no_rays_and_points_behind_are_answered():
    intrinsics = one_camera("OPENCV", CAMERAS["OPENCV"])
    none = torch.zeros(0, dtype=torch.int64)
    assert directions_in_cam(intrinsics, none, torch.zeros(0, 2)).shape == (0, 3)
    behind = torch.tensor([[0.1, 0.1, -1.0], [0.1, 0.1, 0.0], [0.0, 0.0, 1.0]])
    pixels = project(intrinsics, torch.zeros(3, dtype=torch.int64), behind)
    assert pixels[:2].isnan().all()
    assert pixels[2].isfinite().all()


def test_shapes_that_do_not_fit_are_refused():
    intrinsics = one_camera("PINHOLE", CAMERAS["PINHOLE"])
    with pytest.raises(ValueError, match="need one image index"):
        directions_in_cam(intrinsics, torch.zeros(3, dtype=torch.int64), torch.zeros(4, 2))
    with pytest.raises(ValueError, match="need one image index"):
        project(intrinsics, torch.zeros(4, dtype=torch.int64), torch.zeros(4, 2))


@pytest.mark.parametrize("model", CAMERAS)
def test_the_smallest_model_gives_the_parameters_back(model):
    assert smallest_model(full_parameters(model, CAMERAS[model]), model) == (model, CAMERAS[model])


def test_a_model_that_cannot_hold_the_camera_is_left_for_one_that_can():
    assert smallest_model(OpenCVParameters(500, 501, 320, 240), "SIMPLE_PINHOLE")[0] == "PINHOLE"
    assert smallest_model(OpenCVParameters(500, 501, 320, 240, k1=0.1), "SIMPLE_RADIAL")[0] == "OPENCV"
    assert smallest_model(OpenCVParameters(500, 500, 320, 240, p1=0.1), "RADIAL")[0] == "OPENCV"


def test_unknown_models_and_wrong_counts_are_refused():
    with pytest.raises(ValueError, match="OPENCV_FISHEYE"):
        full_parameters("OPENCV_FISHEYE", (1.0,) * 8)
    for model, names in MODEL_PARAMETERS.items():
        with pytest.raises(ValueError, match="parameters"):
            full_parameters(model, (1.0,) * (len(names) + 1))
