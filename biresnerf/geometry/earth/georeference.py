"""Which similarity carries cameras to measured positions, and whether these tell it at all."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from biresnerf.geometry.similarity import Similarity, align_robust

Array = NDArray[np.float64]

# Positions give a frame if there are so many, and if they scatter about the cameras by less than this share of how far
# they spread along their second axis: the turn about the first is off by about as many radians, over the root of their
# number.
LEAST_POSITIONS, MOST_SCATTER = 6, 0.2
FARTHEST = 10  # median distances from the middle: a position beyond is wrong
THINNEST = 1e-3  # of the spread along the first axis, the least along the second
# The median distance of three normal deviates, and how many times the distance that the stated accuracy would give
# positions may be away.
NORMAL_MEDIAN, BELIEVED = 1.54, 3.0


@dataclass(frozen=True, eq=False)
class Georeference:
    """How cameras lie among measured positions.

    Attributes:
        metres_from_world: a point of the cameras' world in metres, along the axes of the positions.
        used: bool [m], which positions are not far beyond the others.
        residual_m: float64 [m], distance of each camera from its position.
    """

    metres_from_world: Similarity
    used: NDArray[np.bool_]
    residual_m: Array


class NoGeoreference(ValueError):
    """Positions that tell no frame; the message says why, in a user's words."""


def fit_positions(world_from_cam: Array, positions_m: Array, accuracy_m: Array | None = None) -> Georeference:
    """The similarity from cameras [m, 4, 4] to their measured positions [m, 3], robust to wrong ones.

    Args:
        world_from_cam: the cameras.
        positions_m: in metres, in any frame.
        accuracy_m: the stated standard deviation of each position along each axis [m], NaN where it is not known.

    Raises:
        NoGeoreference: too few positions; all on a line, or scattered as far as they spread, so that a turn is open; or
            farther from the cameras than their accuracy allows.
    """
    if len(positions_m) < LEAST_POSITIONS:
        raise NoGeoreference(f"{len(positions_m)} photos have a position, and {LEAST_POSITIONS} are needed")
    # The fit is robust from a start that a few gross errors must not spoil.
    away = np.linalg.norm(positions_m - np.median(positions_m, axis=0), axis=1)
    if not away.any():
        raise NoGeoreference("all positions are at one place")
    used = away <= FARTHEST * np.median(away)
    there = np.tile(np.eye(4), (len(positions_m), 1, 1))
    there[:, :3, 3] = positions_m
    try:
        metres_from_world = align_robust(world_from_cam[used], there[used])
    except ValueError:
        raise NoGeoreference("the cameras are at one place") from None
    found = metres_from_world.apply_to_poses(world_from_cam)[:, :3, 3]
    apart = np.linalg.norm(found - positions_m, axis=1)
    residual = float(np.median(apart[used]))
    near = found[used & (apart <= 3 * residual)]
    spread = np.linalg.svd(near - near.mean(0), compute_uv=False)[:2] / len(near) ** 0.5
    if not spread[1] > THINNEST * spread[0]:
        raise NoGeoreference("the cameras lie on a line, about which the positions leave the turn open")
    if not residual < MOST_SCATTER * spread[1]:  # neither where both are zero
        raise NoGeoreference(
            f"positions scatter by {residual:.2g} m, and the cameras spread by {spread[1]:.2g} m across their line"
        )
    _refuse_beyond_accuracy(residual, accuracy_m[used] if accuracy_m is not None else np.full(1, np.nan))
    return Georeference(metres_from_world, used, apart)


def _refuse_beyond_accuracy(residual_m: float, accuracy_m: Array) -> None:
    known = accuracy_m[np.isfinite(accuracy_m)]
    if len(known) < 0.5 * len(accuracy_m):
        return
    stated = float(np.median(known))
    if residual_m > BELIEVED * NORMAL_MEDIAN * stated:
        raise NoGeoreference(
            f"the cameras are {residual_m:.2g} m from their positions (median), whose stated accuracy is {stated:.2g} m"
        )
