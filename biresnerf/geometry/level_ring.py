"""Upright cameras on a ring about the z axis."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from biresnerf.geometry.rigid import motion_of


def level_ring(azimuth: NDArray[np.float64], elevation: float = 0.0) -> NDArray[np.float64]:
    """Poses world_from_cam [n, 4, 4] at distance one from the origin, which the cameras look at.

    Args:
        azimuth: of each camera [n], radians.
        elevation: of all cameras above the origin's plane, radians.
    """
    cosine, sine, zero = np.cos(azimuth), np.sin(azimuth), np.zeros_like(azimuth)
    outward = np.stack(
        [np.cos(elevation) * cosine, np.cos(elevation) * sine, np.full_like(azimuth, np.sin(elevation))], 1
    )
    right = np.stack([-sine, cosine, zero], 1)
    return motion_of(np.stack([right, np.cross(-outward, right), -outward], 2), outward)


def order_on_ring(world_from_cam: NDArray[np.float64]) -> NDArray[np.int64]:
    """Indices of cameras [n] in the order of their azimuths about the z axis, from poses [n, 4, 4]."""
    azimuth = np.arctan2(world_from_cam[:, 1, 3], world_from_cam[:, 0, 3])
    # Rounding may put the first camera just below zero.
    return np.argsort((azimuth + 1e-6) % (2 * np.pi), kind="stable")
