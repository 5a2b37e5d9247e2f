"""Lenses through which pixels have no viewing ray: against the radial function written out, and a dense grid."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from biresnerf.geometry.camera.camera_models import FullParameters
from biresnerf.geometry.camera.lens import MAX_DISTORTION, lens_problem, lens_reach

WIDTH, HEIGHT = 640, 480


@settings(max_examples=150, deadline=None)
@given(st.floats(-1.5, 0.5), st.floats(-1.0, 1.0), st.floats(0.3, 3.0))
def test_a_radial_fold_is_found_where_the_radius_stops_growing(k1, k2, zoom):
    full = FullParameters(zoom * WIDTH, zoom * WIDTH, WIDTH / 2, HEIGHT / 2, k1, k2)
    corner = np.hypot(WIDTH / 2, HEIGHT / 2) / (zoom * WIDTH)
    r = np.linspace(1e-9, 20, 40_001)
    distorted = r * (1 + k1 * r**2 + k2 * r**4)
    growth = (1 + 3 * k1 * r**2 + 5 * k2 * r**4) * distorted / r  # of area
    stops = np.flatnonzero(growth < 0.1)
    reach = distorted[stops[0]] if len(stops) else np.inf
    corner_seen = np.interp(
        corner, distorted[: stops[0] if len(stops) else None], r[: stops[0] if len(stops) else None]
    )
    moved = max(corner_seen / corner, corner / corner_seen) - 1
    if abs(reach - corner) > 0.01 * corner and abs(moved - MAX_DISTORTION) > 0.05:
        found = lens_problem(full, WIDTH, HEIGHT)
        wrong = reach < corner or moved > MAX_DISTORTION
        # What is left are lenses that only a path from the centre undoes.
        assert (found is not None) == wrong or (found is not None and "undone" in found)


@pytest.mark.parametrize(
    "coefficients",
    [
        (0.0, 0.0, 0.0, 0.0),
        (0.0578421, -0.0805099, -0.000980296, 0.00015575),  # a phone
        (-0.28, 0.07, 0.0002, 0.00002),  # a wide street camera
        (0.5, 0.0, 0.0, 0.0),
        (0.0, 0.0, 0.02, -0.02),
        (0.52, -2.69, 0.0006, -0.0002, 1.5, 0.4, -2.5, 1.43),  # a depth camera's rational model
    ],
)
def test_real_lenses_pass(coefficients):
    assert lens_problem(FullParameters(500, 500, 320, 240, *coefficients), WIDTH, HEIGHT) is None


def test_a_drones_lens_that_is_nearly_steep_enough_to_fold_in_the_corner_passes():
    """A Phantom 4 RTK's, as its maker measured it: the corner's area is seen at an eighth of the middle's."""
    radial_and_tangential = (-0.269478, 0.115681, -8.75619e-5, -0.000306177, -0.0357628)
    drone = FullParameters(3659.78, 3653.17, 2728.29, 1869.9, *radial_and_tangential)
    assert lens_problem(drone, 5472, 3648) is None


@pytest.mark.parametrize(
    ("coefficients", "words"),
    [
        ((-3.0, 0.0, 0.0, 0.0), "folds"),
        ((-0.6, 0.0, 0.0, 0.0), "folds"),
        ((-0.3, 0.0, 0.0, 0.15), "folds"),
        ((1000.0, 0.0, 0.0, 0.0), "times its distance"),
        ((0.0, 0.0, 5.0, 0.0), "folds"),
    ],
)
def test_impossible_lenses_are_told_why(coefficients, words):
    problem = lens_problem(FullParameters(500, 500, 320, 240, *coefficients), WIDTH, HEIGHT)
    assert problem is not None
    assert words in problem


def fisheye(focal: float, *coefficients: float) -> FullParameters:
    names = ("k1", "k2", "k3", "k4")
    return FullParameters(
        focal, focal, 320, 240, **dict(zip(names, coefficients, strict=False)), fisheye=True
    )


def test_fisheyes_may_look_behind_them_but_not_all_around():
    corner = float(np.hypot(320, 240))
    assert lens_problem(fisheye(corner / 2.0), WIDTH, HEIGHT) is None  # 115 degrees from the axis
    assert lens_problem(fisheye(corner / 2.0, -0.02, 0.002), WIDTH, HEIGHT) is None
    assert "180" in (lens_problem(fisheye(corner / 3.2), WIDTH, HEIGHT) or "")
    assert "folds" in (lens_problem(fisheye(corner / 2.0, -0.2), WIDTH, HEIGHT) or "")


def test_the_reach_is_the_undistorted_radius_of_the_farthest_corner():
    corner = float(np.hypot(320, 240))
    assert lens_reach(FullParameters(500, 500, 320, 240), WIDTH, HEIGHT) == np.inf
    assert lens_reach(fisheye(corner / 2.0), WIDTH, HEIGHT) == pytest.approx(2.0)
    reach = lens_reach(FullParameters(500, 500, 320, 240, k1=-0.15), WIDTH, HEIGHT)
    assert reach * (1 - 0.15 * reach**2) == pytest.approx(corner / 500, abs=1e-12)
