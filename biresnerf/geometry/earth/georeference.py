"""The similarity from cameras to measured positions, and whether these determine it at all."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from biresnerf.arrays import Array
from biresnerf.geometry.pose_error import rotation_between_deg
from biresnerf.geometry.rigid import motion_of
from biresnerf.geometry.similarity import Similarity, align_robust

# Positions give a frame if there are so many, and if they scatter about the cameras by less than this share of how far
# they spread along their second axis: the turn about the first is off by about as many radians, over the root of their
# number.
LEAST_POSITIONS, MOST_SCATTER = 6, 0.2
FARTHEST = 10  # median distances from the middle: a position beyond is wrong
LINE, MOST_TURNED_DEG = 0.05, 10.0  # positions so near a line leave its turn to angles, which may err so far
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
        doubt: a sentence where that is far more than the positions' stated accuracy, else empty.
    """

    metres_from_world: Similarity
    used: NDArray[np.bool_]
    residual_m: Array
    doubt: str = ""


class NoGeoreference(ValueError):
    """Positions that determine no frame; the message tells users why."""


def fit_positions(
    world_from_cam: Array,
    positions_m: Array,
    accuracy_m: Array | None = None,
    rotations: Array | None = None,
) -> Georeference:
    """The similarity from cameras [m, 4, 4] to their measured positions [m, 3], robust to wrong ones.

    Args:
        world_from_cam: the cameras.
        positions_m: in metres, in any frame.
        accuracy_m: stated standard deviations of the positions along the axes [m, 3], NaN where they are not known.
        rotations: of the cameras in the frame of the positions [m, 3, 3], as a gimbal measured them, NaN where it did
            not; they fix the rotation about a line.

    Raises:
        NoGeoreference: too few positions; or all on a line, or scattered as far as they spread: a turn is open.
    """
    if len(positions_m) < LEAST_POSITIONS:
        raise NoGeoreference(f"{len(positions_m)} photos have a position, and {LEAST_POSITIONS} are needed")
    # The fit is robust from a start that a few gross errors must not spoil.
    used = not_far_off(positions_m)
    if not (positions_m != positions_m[0]).any():
        raise NoGeoreference("all positions are at one place")
    there = motion_of(np.tile(np.eye(3), (len(positions_m), 1, 1)), positions_m)
    try:
        metres_from_world = align_robust(world_from_cam[used], there[used])
    except ValueError:
        raise NoGeoreference("the cameras are at one place") from None
    if rotations is not None and _spread(there[used][:, :3, 3])[1] < LINE * _spread(there[used][:, :3, 3])[0]:
        turned = used & np.isfinite(rotations).all((1, 2))
        if turned.sum() >= LEAST_POSITIONS:
            return _along_a_line(world_from_cam, there, rotations, turned, accuracy_m)
    found = metres_from_world.apply_to_poses(world_from_cam)[:, :3, 3]
    apart = np.linalg.norm(found - positions_m, axis=1)
    residual = float(np.median(apart[used]))
    near = found[used & (apart <= 3 * residual)]
    spread = _spread(near)
    if not spread[1] > THINNEST * spread[0]:
        raise NoGeoreference("the cameras lie on a line, about which the positions leave the turn open")
    if not residual < MOST_SCATTER * spread[1]:  # neither where both are zero
        raise NoGeoreference(
            f"positions scatter by {residual:.2g} m, and the cameras spread by {spread[1]:.2g} m across their line"
        )
    doubt = "" if accuracy_m is None else _doubt(apart[used], accuracy_m[used])
    return Georeference(metres_from_world, used, apart, doubt)


def not_far_off(positions_m: Array) -> NDArray[np.bool_]:
    """Mask [m] of positions that are not so far from the others that they must be wrong."""
    away = np.linalg.norm(positions_m - np.median(positions_m, axis=0), axis=1)
    return np.asarray(away <= FARTHEST * np.median(away))


def _along_a_line(
    world_from_cam: Array, there: Array, rotations: Array, used: NDArray[np.bool_], accuracy_m: Array | None
) -> Georeference:
    """The similarity of cameras on a line; rotations [m, 3, 3] fix the turn about it."""
    there[:, :3, :3] = rotations
    found = align_robust(world_from_cam[used], there[used], with_rotations=True)
    moved = found.apply_to_poses(world_from_cam)
    turned = float(np.median(rotation_between_deg(moved[used], there[used])))
    apart = np.linalg.norm(moved[:, :3, 3] - there[:, :3, 3], axis=1)
    if (
        turned > MOST_TURNED_DEG
        or float(np.median(apart[used])) > MOST_SCATTER * _spread(there[used][:, :3, 3])[0]
    ):
        raise NoGeoreference(
            f"the cameras lie on a line, and the gimbal's angles are {turned:.2g} degrees from theirs"
        )
    doubt = "" if accuracy_m is None else _doubt(apart[used], accuracy_m[used])
    return Georeference(found, used, apart, doubt)


def _spread(points: Array) -> Array:
    """Root mean squares along the first two axes of points [m, 3]."""
    return np.asarray(np.linalg.svd(points - points.mean(0), compute_uv=False)[:2] / len(points) ** 0.5)


def _doubt(apart_m: Array, accuracy_m: Array) -> str:
    known = np.asarray(np.isfinite(accuracy_m).all(1))
    if 2 * known.sum() < len(known):
        return ""
    stated = np.sqrt((accuracy_m[known] ** 2).mean(1))
    if not float(np.median(apart_m[known] / stated)) > BELIEVED * NORMAL_MEDIAN:
        return ""
    return (
        f"The cameras are {np.median(apart_m[known]):.2g} m from their measured positions (median), whose stated "
        f"accuracy of {np.median(stated):.2g} m is not believed."
    )
