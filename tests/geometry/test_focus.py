"""The point a rig looks at."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import minimize

from biresnerf.geometry.focus import focus_point
from tests.geometry.rigs import dome, jitter, look_at, similar


def test_a_dome_looks_at_its_centre():
    rig = similar(dome(20, np.random.default_rng(0)), 2.0, np.eye(3), np.array([1e4, -3.0, 7.0]))
    focus = focus_point(rig)
    np.testing.assert_allclose(focus.point, [1e4, -3.0, 7.0], atol=1e-8)
    assert focus.mean_distance == pytest.approx(8.0)
    assert focus.well_posed
    assert focus.in_front == 1.0


def test_a_noisy_rig_has_its_focus_where_squared_distances_to_the_axes_are_least():
    rng = np.random.default_rng(1)
    rig = jitter(dome(12, rng), rng, 0.2, 0.5)

    def squared_distances(point):
        return sum(np.linalg.norm(np.cross(pose[:3, 2], point - pose[:3, 3])) ** 2 for pose in rig)

    expected = minimize(squared_distances, np.zeros(3), tol=1e-12).x
    np.testing.assert_allclose(focus_point(rig).point, expected, atol=1e-5)


def test_parallel_axes_are_reported_and_leave_the_point_at_the_mean_centre():
    rig = np.stack([look_at(np.array([x, 0.0, 0.0]), np.array([x, 5.0, 0.0])) for x in (-1.0, 0.0, 2.0)])
    focus = focus_point(rig)
    assert not focus.well_posed
    assert focus.conditioning == pytest.approx(0.0, abs=1e-12)
    np.testing.assert_allclose(focus.point, [1 / 3, 0, 0], atol=1e-12)


def test_conditioning_is_the_squared_sine_between_two_axes_and_their_bisector():
    half_angle = 0.2
    rig = np.stack(
        [look_at(np.array([s * np.sin(half_angle), -np.cos(half_angle), 0.0]), np.zeros(3)) for s in (-1, 1)]
    )
    assert focus_point(rig).conditioning == pytest.approx(np.sin(half_angle) ** 2)


def test_cameras_that_look_away_have_the_focus_behind_them():
    rig = np.stack([look_at(c, 2 * c) for c in (np.eye(3) * 2)])
    focus = focus_point(rig)
    np.testing.assert_allclose(focus.point, 0, atol=1e-12)
    assert focus.in_front == 0.0


def test_no_camera_is_refused():
    with pytest.raises(ValueError, match="n >= 1"):
        focus_point(np.zeros((0, 4, 4)))
