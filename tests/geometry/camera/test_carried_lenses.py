"""Lenses represented by other models: how far they are from COLMAP's, and how refined ones are converted back."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from biresnerf.geometry.camera.camera import project
from biresnerf.geometry.camera.camera_models import REFINED_PARAMETERS, Camera, FullParameters
from biresnerf.geometry.camera.lens import lens_problem
from biresnerf.geometry.camera.pixel_rays import pixels_of_points, rays_of_pixels
from tests.geometry.camera.lenses import HEIGHT, WIDTH
from tests.geometry.camera.test_camera import colmap, one_camera, pixels_everywhere

__all__ = ["colmap"]  # a fixture

SHAPES = {
    "FOV": [(0.3,), (0.6,), (0.9,), (1.2,)],
    "DIVISION": [(-0.1,), (-0.2,), (-0.4,)],
    "EUCM": [(alpha, beta) for alpha in (0.4, 0.5, 0.6, 0.7) for beta in (0.8, 1.0, 1.2)],
}
# docs/conventions.md: how far carriers are from their lenses at most, in px of 640, by the angle (deg) of view across
# the diagonal.
MOST_PX = {90: 8e-6, 120: 2e-7, 150: 4e-6, 170: 6e-5}

# Lenses of so wide a view bend more.
REFUSED = (("FOV", 150, (0.3,)), ("FOV", 170, (0.3,)), ("EUCM", 170, (0.4, 0.8)))


def radius(model: str, shape: tuple[float, ...], angle: np.ndarray) -> np.ndarray:
    """Distance from the principal point in focal lengths, as the papers have it."""
    if model == "FOV":
        return np.arctan(2 * np.tan(angle) * np.tan(shape[0] / 2)) / shape[0]
    r, z = np.sin(angle), np.cos(angle)
    if model == "EUCM":
        return r / (shape[0] * np.sqrt(shape[1] * r * r + z * z) + (1 - shape[0]) * z)
    return (1 - np.sqrt(1 - 4 * shape[0] * np.tan(angle) ** 2)) / (2 * shape[0] * np.tan(angle))


def seeing(model: str, shape: tuple[float, ...], view_deg: float) -> Camera:
    """The camera of such a lens that sees this much from corner to corner, with pixels a little oblong."""
    corner = float(radius(model, shape, np.radians([view_deg / 2]))[0])
    focal = np.hypot(WIDTH / 2, HEIGHT / 2) / corner
    return Camera(model, WIDTH, HEIGHT, (focal, 1.002 * focal, WIDTH / 2, HEIGHT / 2, *shape))


@pytest.mark.parametrize("view_deg", MOST_PX)
@pytest.mark.parametrize("model", SHAPES)
def test_carriers_show_what_colmaps_lenses_do_as_closely_as_the_docs_say(model, view_deg, colmap):
    pixels = np.concatenate([pixels_everywhere(), [(0, 0), (WIDTH, 0), (0, HEIGHT), (WIDTH, HEIGHT)]])
    for shape in SHAPES[model]:
        camera = seeing(model, shape, view_deg)
        if lens_problem(camera.full(), WIDTH, HEIGHT) is not None:
            assert (model, view_deg, shape) in REFUSED
            continue
        rays = rays_of_pixels(camera.full(), pixels)
        theirs = colmap(model, camera.params, pixels, rays)["pixels"]
        assert np.abs(theirs - pixels).max() < MOST_PX[view_deg]
        ours = project(
            one_camera(model, camera.params),
            torch.zeros(len(rays), dtype=torch.int64),
            torch.from_numpy(rays),
        )
        assert np.abs(ours.numpy() - pixels).max() < 1e-8


@pytest.mark.parametrize("view_deg", [80, 120, 170])
@pytest.mark.parametrize(
    ("model", "before", "after"),
    [("FOV", (0.9,), (0.95,)), ("EUCM", (0.6, 1.1), (0.64, 1.0)), ("DIVISION", (-0.2,), (-0.25,))],
    ids=["FOV", "EUCM", "DIVISION"],
)
def test_what_refining_finds_is_the_lens_of_that_formula_that_took_the_photos(model, before, after, view_deg):
    """A lens is freed as the refinement frees it, and meets another of its formula as nearly as it then can."""
    camera = seeing(model, before, view_deg)
    angle = np.linspace(0, np.radians(view_deg / 2), 200)[1:]
    points = np.stack([np.sin(angle), 0 * angle, np.cos(angle)], 1)
    true = 1.01 * camera.params[0] * radius(model, after, angle) + WIDTH / 2
    free = [name for name in REFINED_PARAMETERS[model] if name.startswith("k")]
    lens = found(camera.full(), free, points, true)
    refined = camera.with_lens(lens)
    assert refined.model == model
    np.testing.assert_allclose(refined.params[4:], after, rtol=2e-3)
    assert np.abs(pixels_of_points(refined.full(), points)[:, 0] - true).max() < 0.05
    assert refined.params[1] / refined.params[0] == pytest.approx(1.002, rel=1e-12)


def found(lens: FullParameters, free: list[str], points: np.ndarray, true: np.ndarray) -> FullParameters:
    """The lens with its focal length and free coefficients where `true` (px along x) asks for them; all is linear."""

    def column(**values: float) -> np.ndarray:
        return pixels_of_points(lens._replace(fx=1.0, cx=0.0, **values), points)[:, 0]

    plain = column(**dict.fromkeys(free, 0.0))
    ones = [column(**dict.fromkeys(free, 0.0) | {name: 1.0}) - plain for name in free]
    focal, *rest = np.linalg.lstsq(np.stack([plain, *ones], 1), true - lens.cx, rcond=None)[0].tolist()
    moved = dict(zip(free, (value / focal for value in rest), strict=True))
    return lens._replace(fx=focal, fy=focal * lens.fy / lens.fx, **moved)


@pytest.mark.parametrize("view_deg", [80, 120])
def test_a_lens_that_is_none_of_the_formula_gets_the_smallest_model_that_has_it(view_deg):
    camera = seeing("FOV", (0.9,), view_deg)
    full = camera.full()
    moved = full._replace(p1=0.01) if view_deg == 80 else full._replace(p1=0.01, k1=full.k1 + 0.001)
    other = camera.with_lens(moved)
    assert other.model == ("FULL_OPENCV" if view_deg == 80 else "THIN_PRISM_FISHEYE")
    pixels = pixels_everywhere()
    rays = rays_of_pixels(moved, pixels)
    assert np.abs(pixels_of_points(other.full(), rays) - pixels).max() < 0.01


def test_a_half_size_photo_has_the_same_rays():
    for model, shapes in SHAPES.items():
        camera = seeing(model, shapes[1], 110)
        pixels = pixels_everywhere()
        small = camera.resized(WIDTH // 2, HEIGHT // 2)
        assert small.model == model
        np.testing.assert_allclose(
            rays_of_pixels(small.full(), pixels / 2), rays_of_pixels(camera.full(), pixels), atol=1e-9
        )
    square = Camera("SIMPLE_DIVISION", WIDTH, HEIGHT, (500.0, 320.0, 240.0, -0.2))
    assert square.resized(WIDTH // 2, HEIGHT).model == "DIVISION"


@pytest.mark.parametrize(
    ("model", "params"),
    [
        ("FOV", (200.0, 200.0, 320.0, 240.0, 1.2)),  # 2 rad of 1.2 are more than a half turn
        ("EUCM", (200.0, 200.0, 320.0, 240.0, 0.7, 1.2)),
        ("DIVISION", (500.0, 500.0, 320.0, 240.0, float("nan"))),
    ],
)
def test_a_lens_that_shows_nothing_in_the_corners_is_refused(model, params):
    with pytest.raises(ValueError, match="corners"):
        Camera(model, WIDTH, HEIGHT, params).full()
