"""Lenses that no pixel can be seen through: against the radial function written out, and a dense grid."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from biresnerf.geometry.camera_models import OpenCVParameters
from biresnerf.geometry.lens import MAX_DISTORTION, lens_problem

WIDTH, HEIGHT = 640, 480


@settings(max_examples=300, deadline=None)
@given(st.floats(-1.5, 0.5), st.floats(-1.0, 1.0), st.floats(0.3, 3.0))
def test_a_radial_fold_is_found_where_the_radius_stops_growing(k1, k2, zoom):
    full = OpenCVParameters(zoom * WIDTH, zoom * WIDTH, WIDTH / 2, HEIGHT / 2, k1, k2)
    corner = np.hypot(WIDTH / 2, HEIGHT / 2) / (zoom * WIDTH)
    r = np.linspace(1e-9, 20, 400_001)
    distorted = r * (1 + k1 * r**2 + k2 * r**4)
    growth = (1 + 3 * k1 * r**2 + 5 * k2 * r**4) * distorted / r  # of area
    stops = np.flatnonzero(growth < 0.1)
    reach = distorted[stops[0]] if len(stops) else np.inf
    wild = abs(k1) * corner**2 + abs(k2) * corner**4 > MAX_DISTORTION
    if abs(reach - corner) > 0.01 * corner:
        assert (lens_problem(full, WIDTH, HEIGHT) is not None) == (reach < corner or wild)


@pytest.mark.parametrize(
    "coefficients",
    [
        (0.0, 0.0, 0.0, 0.0),
        (0.0578421, -0.0805099, -0.000980296, 0.00015575),  # a phone
        (-0.28, 0.07, 0.0002, 0.00002),  # a wide street camera
        (0.5, 0.0, 0.0, 0.0),
        (0.0, 0.0, 0.02, -0.02),
    ],
)
def test_real_lenses_pass(coefficients):
    assert lens_problem(OpenCVParameters(500, 500, 320, 240, *coefficients), WIDTH, HEIGHT) is None


@pytest.mark.parametrize(
    ("coefficients", "words"),
    [
        ((-3.0, 0.0, 0.0, 0.0), "corner"),
        ((-0.6, 0.0, 0.0, 0.0), "folds"),
        ((-0.3, 0.0, 0.0, 0.15), "folds"),
        ((1000.0, 0.0, 0.0, 0.0), "corner"),
        ((0.0, 0.0, 5.0, 0.0), "corner"),
    ],
)
def test_impossible_lenses_are_told_why(coefficients, words):
    problem = lens_problem(OpenCVParameters(500, 500, 320, 240, *coefficients), WIDTH, HEIGHT)
    assert problem is not None
    assert words in problem
