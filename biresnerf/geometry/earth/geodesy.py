"""Positions on Earth: WGS84, and local axes that point east, north and up."""

from __future__ import annotations

import numpy as np

from biresnerf.arrays import Array
from biresnerf.geometry.rigid import rotation_about

# WGS84 (NIMA TR8350.2): the ellipsoid's semi-major axis, m, and flattening.
SEMI_MAJOR_AXIS, FLATTENING = 6_378_137.0, 1 / 298.257223563


def earth_centred(place: Array) -> Array:
    """Earth-centred, Earth-fixed coordinates [..., 3], m, of latitude, longitude (degrees) and height (m) [..., 3]."""
    latitude, longitude, height = np.radians(place[..., 0]), np.radians(place[..., 1]), place[..., 2]
    squared = FLATTENING * (2 - FLATTENING)  # of the eccentricity
    normal = SEMI_MAJOR_AXIS / np.sqrt(1 - squared * np.sin(latitude) ** 2)
    across = (normal + height) * np.cos(latitude)
    along = (normal * (1 - squared) + height) * np.sin(latitude)
    return np.stack([across * np.cos(longitude), across * np.sin(longitude), along], -1)


def east_north_up(place: Array, origin: Array) -> Array:
    """Coordinates [..., 3], m, along east, north and up at `origin` [3]; both as in `earth_centred`."""
    return np.asarray((earth_centred(place) - earth_centred(origin)) @ _axes(origin).T)


def place_of(enu_m: Array, origin: Array) -> Array:
    """Latitude, longitude (degrees) and height (m) [..., 3] of `east_north_up` coordinates: its inverse.

    By Bowring's formula (1985), exact to a millimetre below 100 km of height.
    """
    x, y, z = np.moveaxis(enu_m @ _axes(origin) + earth_centred(origin), -1, 0)
    squared = FLATTENING * (2 - FLATTENING)
    polar_axis = SEMI_MAJOR_AXIS * (1 - FLATTENING)
    across = np.hypot(x, y)
    angle = np.arctan2(z * SEMI_MAJOR_AXIS, across * polar_axis)
    latitude = np.arctan2(
        z + squared / (1 - squared) * polar_axis * np.sin(angle) ** 3,
        across - squared * SEMI_MAJOR_AXIS * np.cos(angle) ** 3,
    )
    normal = SEMI_MAJOR_AXIS / np.sqrt(1 - squared * np.sin(latitude) ** 2)
    height = across * np.cos(latitude) + z * np.sin(latitude) - SEMI_MAJOR_AXIS**2 / normal
    return np.stack([np.degrees(latitude), np.degrees(np.arctan2(y, x)), height], -1)


def held_so(angles_deg: Array) -> Array:
    """Rotations [m, 3, 3] from a camera's axes to east, north and up, of a gimbal's angles [m, 3].

    Yaw is from north over east, pitch above the horizon, roll to the right (clockwise as the camera sees it).
    """
    yaw, pitch, roll = np.radians(angles_deg).T
    level = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])  # north, with the right side east
    return np.asarray(rotation_about(2, -yaw) @ rotation_about(0, pitch) @ level @ rotation_about(2, roll))


def _axes(origin: Array) -> Array:
    """East, north and up at a place, as rows in earth-centred coordinates."""
    latitude, longitude = np.radians(origin[:2])
    sines, cosines = np.sin([latitude, longitude]), np.cos([latitude, longitude])
    return np.array(
        [
            [-sines[1], cosines[1], 0],
            [-sines[0] * cosines[1], -sines[0] * sines[1], cosines[0]],
            [cosines[0] * cosines[1], cosines[0] * sines[1], sines[0]],
        ]
    )
