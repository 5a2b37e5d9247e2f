"""Positions on Earth against published coordinates."""

from __future__ import annotations

import numpy as np
import pytest

from biresnerf.geometry.earth.geodesy import SEMI_MAJOR_AXIS, earth_centred, east_north_up, place_of

# Of pymap3d's tests (Hirsch, Journal of Open Source Software 2018): a place, and another one as seen from there.
PLACE, ITS_EARTH_CENTRED = [42.0, -82.0, 200.0], [660675.2518247, -4700948.68316, 4245737.66222]
OTHER, ITS_EAST_NORTH_UP = [42.002582, -81.997752, 1139.7018], [186.277521, 286.842228, 939.692621]


def test_earth_centred_coordinates_are_the_published_ones():
    np.testing.assert_allclose(earth_centred(np.array(PLACE)), ITS_EARTH_CENTRED, atol=1e-4)


def test_local_coordinates_are_the_published_ones():
    # The published place is rounded to a millionth of a degree.
    np.testing.assert_allclose(east_north_up(np.array(OTHER), np.array(PLACE)), ITS_EAST_NORTH_UP, atol=0.06)


@pytest.mark.parametrize("longitude", [-180.0, -30.0, 0.0, 179.9])
def test_a_degree_along_the_equator_points_east_and_up_is_up(longitude):
    origin = np.array([0.0, longitude, 0.0])
    east, up = east_north_up(np.array([[0.0, longitude + 1e-4, 0.0], [0.0, longitude, 5.0]]), origin)
    np.testing.assert_allclose(east, [np.radians(1e-4) * SEMI_MAJOR_AXIS, 0, 0], atol=1e-4)
    np.testing.assert_allclose(up, [0, 0, 5], atol=1e-8)


def test_a_place_comes_back_from_its_local_coordinates():
    rng = np.random.default_rng(2)
    for origin in rng.uniform([-89, -180, -400], [89, 180, 8000], (50, 3)):
        there = rng.uniform(-3000, 3000, (20, 3))
        np.testing.assert_allclose(east_north_up(place_of(there, origin), origin), there, atol=2e-4)
