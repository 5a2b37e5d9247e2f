"""Cameras: against pycolmap's, round trips, and COLMAP's parameter orders."""

from __future__ import annotations

import importlib.util
import json
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, assume, given, settings
from hypothesis import strategies as st
from scipy.optimize import brentq

from biresnerf.geometry.camera.camera import (
    Intrinsics,
    directions_in_cam,
    directions_with_gradient,
    in_view,
    project,
)
from biresnerf.geometry.camera.camera_models import (
    FAMILY_MODELS,
    FISHEYE_MODELS,
    MODEL_IDS,
    MODEL_PARAMETERS,
    Camera,
    full_parameters,
)
from biresnerf.geometry.camera.lens import lens_problem
from tests.geometry.camera.lenses import CAMERAS, HEIGHT, WIDTH

# zlib first: pycolmap's wheels carry their own, and Python's must be bound before (double free otherwise).
PYCOLMAP = """
import zlib, json, sys
import numpy as np, pycolmap
for line in sys.stdin:
    request = json.loads(line)
    camera = pycolmap.Camera(camera_id=1, model=request["model"], width=request["width"], height=request["height"],
                             params=request["params"])
    answer = {"id": int(camera.model), "rays": np.asarray(camera.cam_from_img(np.array(request["pixels"]))).tolist(),
              "pixels": np.asarray(camera.img_from_cam(np.array(request["points"]))).tolist()}
    print(json.dumps(answer), flush=True)
"""


@pytest.fixture(scope="module")
def colmap():
    """COLMAP's own undistortion of pixels and projection of points, from a process of its own."""
    if importlib.util.find_spec("pycolmap") is None:
        pytest.skip("pycolmap is not installed")
    command = [sys.executable, "-c", PYCOLMAP]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:

        def ask(model, params, pixels, points):
            request = {"model": model, "width": WIDTH, "height": HEIGHT, "params": params}
            request |= {"pixels": pixels.tolist(), "points": points.tolist()}
            process.stdin.write(json.dumps(request) + "\n")
            process.stdin.flush()
            return {key: np.array(value) for key, value in json.loads(process.stdout.readline()).items()}

        yield ask
        process.stdin.close()


def one_camera(model: str, params: tuple[float, ...]) -> Intrinsics:
    return Intrinsics.from_cameras([Camera(model, WIDTH, HEIGHT, params)])


def pixels_everywhere(count: int = 200) -> np.ndarray:
    return np.random.default_rng(0).uniform(0, 1, (count, 2)) * (WIDTH, HEIGHT)


@pytest.mark.parametrize("model", CAMERAS)
def test_directions_projection_and_ids_agree_with_colmap(model, colmap):
    pixels = pixels_everywhere()
    rng = np.random.default_rng(1)
    points = np.concatenate([rng.uniform(-0.4, 0.4, (200, 2)), np.ones((200, 1))], axis=1) * rng.uniform(
        1, 9, (200, 1)
    )
    theirs = colmap(model, CAMERAS[model], pixels, points)
    assert theirs["id"] == MODEL_IDS[model]
    intrinsics, index = one_camera(model, CAMERAS[model]), torch.zeros(200, dtype=torch.int64)
    directions = directions_in_cam(intrinsics, index, torch.from_numpy(pixels)).numpy()
    carried = model not in FAMILY_MODELS
    slopes = directions[:, :2] / directions[:, 2:]
    np.testing.assert_allclose(slopes, theirs["rays"][:, :2], atol=1e-7, rtol=1e-6 if carried else 1e-7)
    ours = project(intrinsics, index, torch.from_numpy(points)).numpy()
    np.testing.assert_allclose(ours, theirs["pixels"], atol=1e-5 if carried else 1e-8)


small = st.floats(-1.0, 1.0, allow_nan=False)
# How large a coefficient is drawn: real lenses of the kind, and beyond, to where `lens_problem` refuses.
SIZES = {"k1": 1.5, "k2": 1.5, "p1": 0.1, "p2": 0.1, "k3": 1.0, "k4": 1.5, "k5": 1.5, "k6": 1.0}
SHAPES = {"omega": (0.3, 1.2), "k": (-0.4, 0.1), "alpha": (0.4, 0.7), "beta": (0.8, 1.2)}
# What docs/conventions.md says of lenses that others carry, for photos of this size.
CARRIED_PX = 1e-3
FISHEYE_SIZES = {
    "k1": 0.2,
    "k2": 0.1,
    "k3": 0.05,
    "k4": 0.02,
    "p1": 0.05,
    "p2": 0.05,
    "sx1": 0.05,
    "sy1": 0.05,
}


@st.composite
def cameras(draw, models=tuple(MODEL_PARAMETERS)):
    """A model and parameters that pass for a real lens over the image."""
    model = draw(st.sampled_from(models))
    fisheye = model in FISHEYE_MODELS
    focal = WIDTH * draw(st.floats(0.25, 1.0) if fisheye else st.floats(0.5, 4.0))
    params = []
    for name in MODEL_PARAMETERS[model]:
        if name in ("f", "fx", "fy"):
            params.append(focal * (draw(st.floats(0.8, 1.25)) if name == "fy" else 1.0))
        elif name in ("cx", "cy"):
            params.append((WIDTH if name == "cx" else HEIGHT) * (0.5 + 0.1 * draw(small)))
        elif name in SHAPES:
            params.append(draw(st.floats(*SHAPES[name])))
        else:
            params.append((FISHEYE_SIZES if fisheye else SIZES)[name] * draw(small))
    try:
        lens = Camera(model, WIDTH, HEIGHT, tuple(params)).full()
    except ValueError:  # the corners show nothing
        assume(False)
    assume(lens_problem(lens, WIDTH, HEIGHT) is None)
    return model, tuple(params)


@settings(
    max_examples=60, deadline=None, suppress_health_check=[HealthCheck.filter_too_much, HealthCheck.too_slow]
)
@given(cameras())
def test_projection_inverts_directions_within_a_millionth_of_a_pixel(camera):
    intrinsics = one_camera(*camera)
    pixels = torch.from_numpy(pixels_everywhere(64))
    index = torch.zeros(64, dtype=torch.int64)
    directions = directions_in_cam(intrinsics, index, pixels)
    torch.testing.assert_close(directions.norm(dim=1), torch.ones(64, dtype=torch.float64))
    assert (project(intrinsics, index, 7.0 * directions) - pixels).abs().max() < 1e-6
    assert in_view(intrinsics, index, 7.0 * directions).all()


@settings(
    max_examples=40,
    deadline=None,
    suppress_health_check=[
        HealthCheck.filter_too_much,
        HealthCheck.too_slow,
        HealthCheck.function_scoped_fixture,
    ],
)
@given(camera=cameras())
def test_colmap_projects_our_directions_to_their_pixels_within_a_millionth(colmap, camera):
    intrinsics, pixels = one_camera(*camera), pixels_everywhere(64)
    directions = directions_in_cam(intrinsics, torch.zeros(64, dtype=torch.int64), torch.from_numpy(pixels))
    ahead = directions.numpy()[:, 2] > 0.05  # COLMAP's fisheyes end at 90 degrees
    theirs = colmap(*camera, pixels, directions.numpy())
    most = 1e-6 if camera[0] in FAMILY_MODELS else CARRIED_PX
    assert np.abs(theirs["pixels"][ahead] - pixels[ahead]).max(initial=0.0) < most


@settings(max_examples=25, deadline=None, suppress_health_check=[HealthCheck.filter_too_much])
@given(cameras(("OPENCV_FISHEYE",)), st.floats(0.0, 1.0))
def test_a_fisheyes_angle_solves_its_polynomial(camera, share):
    """Against a bracketing root finder, on the image's diagonal, beyond 90 degrees too."""
    full = full_parameters(*camera)
    pixel = np.array([full.cx, full.cy]) * (1 - share)  # towards the corner
    target = float(np.hypot((pixel[0] - full.cx) / full.fx, (pixel[1] - full.cy) / full.fy))
    k = np.array([1.0, full.k1, full.k2, full.k3, full.k4])
    powers = 2 * np.arange(5) + 1
    grid = np.linspace(0, np.pi, 2000)
    values = (k * grid[:, None] ** powers).sum(1)
    first = int(np.argmax(values >= target))
    expected = 0.0
    if target > 0:
        expected = brentq(
            lambda t: float((k * t**powers).sum()) - target, grid[first - 1], grid[first], xtol=1e-14
        )
    ray = directions_in_cam(one_camera(*camera), torch.zeros(1, dtype=torch.int64), torch.tensor(pixel[None]))
    angle = float(torch.atan2(ray[0, :2].norm(), ray[0, 2]))
    assert angle == pytest.approx(expected, abs=1e-9)


def test_a_fisheye_looks_beyond_90_degrees_and_projects_what_is_beside_and_behind_it():
    intrinsics = one_camera("OPENCV_FISHEYE", (160.0, 160.0, 320.0, 240.0, 0.0, 0.0, 0.0, 0.0))
    index = torch.zeros(3, dtype=torch.int64)
    pixels = torch.tensor(
        [[320 + 160 * np.pi / 2, 240.0], [320.0, 240 - 160 * 1.4], [320 + 160 * 1.9, 240.0]],
        dtype=torch.float64,
    )
    rays = directions_in_cam(intrinsics, index, pixels)
    expected = [[1, 0, 0], [0, -np.sin(1.4), np.cos(1.4)], [np.sin(1.9), 0, np.cos(1.9)]]
    np.testing.assert_allclose(rays.numpy(), expected, atol=1e-7)
    np.testing.assert_allclose(project(intrinsics, index, rays).numpy(), pixels.numpy(), atol=1e-9)
    assert in_view(intrinsics, index, rays).all()
    nowhere = torch.tensor([[0.0, 0.0, -1.0], [0.0, 0.0, 0.0], [1e-3, 0.0, -1.0]])
    assert project(intrinsics, index, nowhere).isnan().all(1).tolist() == [True, True, False]
    assert not in_view(intrinsics, index, nowhere).any()


def test_where_the_lens_formula_folds_back_into_the_image_nothing_is_in_view():
    """With k1 = -0.15 slopes beyond 1.49 come back towards the centre."""
    intrinsics = one_camera("SIMPLE_RADIAL", (500.0, 320.0, 240.0, -0.15))
    points = torch.tensor([[0.3, 0.0, 1.0], [2.55, 0.0, 1.0], [0.3, 0.0, -1.0]])
    index = torch.zeros(3, dtype=torch.int64)
    assert 0 < float(project(intrinsics, index, points)[1, 0]) < WIDTH
    assert in_view(intrinsics, index, points).tolist() == [True, False, False]


def test_each_ray_takes_its_own_images_camera():
    cameras = [Camera(model, WIDTH, HEIGHT, params) for model, params in CAMERAS.items()]
    together = Intrinsics.from_cameras(cameras)
    index = torch.arange(len(cameras)).repeat(30)
    pixels = torch.from_numpy(pixels_everywhere(30 * len(cameras)))
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


@pytest.mark.parametrize(
    "model", ["PINHOLE", "OPENCV", "FULL_OPENCV", "OPENCV_FISHEYE", "THIN_PRISM_FISHEYE"]
)
def test_gradients_by_the_intrinsics_are_those_of_finite_differences(model):
    """Also where every coefficient is zero, and at the principal point."""
    for params in (CAMERAS[model], CAMERAS[model][:4] + (0.0,) * (len(CAMERAS[model]) - 4)):
        start = one_camera(model, params)
        start = replace(start, terms=(4, 3, 4) if model != "PINHOLE" else start.terms)
        pixels = torch.from_numpy(np.concatenate([pixels_everywhere(6), [params[2:4]]]))
        index = torch.zeros(len(pixels), dtype=torch.int64)

        def rays(focal, centre, distortion, start=start, index=index, pixels=pixels):
            lens = replace(
                start, fx=focal[:1], fy=focal[1:], cx=centre[:1], cy=centre[1:], distortion=distortion
            )
            with torch.no_grad():
                solved = directions_in_cam(lens, index, pixels).float()
            return directions_with_gradient(lens, index, pixels, solved)

        inputs = [torch.cat([start.fx, start.fy]), torch.cat([start.cx, start.cy]), start.distortion]
        inputs = [value.detach().clone().requires_grad_() for value in inputs]
        torch.testing.assert_close(rays(*inputs), directions_in_cam(start, index, pixels), atol=1e-11, rtol=0)
        torch.autograd.gradcheck(rays, inputs, eps=1e-6, atol=1e-6, rtol=1e-5)


def test_rays_are_computed_with_as_many_terms_as_the_set_has():
    terms = {model: one_camera(model, params).terms for model, params in CAMERAS.items()}
    assert terms["PINHOLE"] == (0, 0, 0)
    assert terms["SIMPLE_RADIAL"] == (1, 0, 0)
    assert terms["OPENCV"] == (2, 0, 2)
    assert terms["FULL_OPENCV"] == (3, 3, 2)
    assert terms["OPENCV_FISHEYE"] == (4, 0, 0)
    assert terms["THIN_PRISM_FISHEYE"] == (4, 0, 4)
