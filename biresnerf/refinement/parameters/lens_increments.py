"""Changes of a camera's intrinsics as a row of numbers of like size, and the camera that a row makes from another."""

from __future__ import annotations

import math
from typing import Literal

import torch
from torch import Tensor

from biresnerf.geometry.camera.camera_models import REFINED_PARAMETERS, Camera, FullParameters

RefinedPart = Literal["none", "focal", "all"]

# Columns of the increments: logarithms of the focal length and of fy/fx, the principal point in focal lengths, and the
# eleven coefficients of `Intrinsics.distortion`, in the unit that moves the image's corner by its own distance.
FOCAL, ASPECT, CENTRE, DISTORTION = 0, 1, slice(2, 4), slice(4, 15)
COLUMNS = 15
_COEFFICIENTS = (
    "k1",
    "k2",
    "k3",
    "k4",
    "k4",
    "k5",
    "k6",
    "p1",
    "p2",
    "sx1",
    "sy1",
)  # of a fisheye, else of FULL_OPENCV
# Which of them a lens may have. A fisheye's k4 is the fourth of the numerator, a perspective lens's the first of the
# denominator.
_OF_FISHEYES, _OF_OTHERS = (0, 1, 2, 3, 7, 8, 9, 10), (0, 1, 2, 4, 5, 6, 7, 8)
# The corner's distance r by which a unit of each coefficient moves it is r to this power.
_POWERS = (3, 5, 7, 9, 3, 5, 7, 2, 2, 2, 2)


def free_columns(camera: Camera, part: RefinedPart) -> Tensor:
    """Which columns may move, bool [COLUMNS]: those requested that the camera's model has."""
    free = torch.zeros(COLUMNS, dtype=torch.bool)
    if part == "none":
        return free
    free[FOCAL] = True
    if part == "all":
        names, fisheye = REFINED_PARAMETERS[camera.model], camera.full().fisheye
        free[ASPECT] = "fx" in names
        free[CENTRE] = True
        for place in _OF_FISHEYES if fisheye else _OF_OTHERS:
            free[DISTORTION.start + place] = _COEFFICIENTS[place] in names
    return free


def units(camera: Camera) -> Tensor:
    """The change of each distortion coefficient [11] per unit of its increment."""
    full = camera.full()
    x, y = max(full.cx, camera.width - full.cx) / full.fx, max(full.cy, camera.height - full.cy) / full.fy
    corner = (x * x + y * y) ** 0.5
    return torch.tensor([corner ** (1 - power) for power in _POWERS], dtype=torch.float64)


def moved_camera(camera: Camera, increments: Tensor, unit: Tensor) -> Camera:
    """A camera with increments [COLUMNS], in the same model where that has a place for all of them."""
    p, q = camera.full(), increments
    above_below_tangential = (q[DISTORTION] * unit).tolist()
    places = _OF_FISHEYES if p.fisheye else _OF_OTHERS
    coefficients = {
        _COEFFICIENTS[i]: getattr(p, _COEFFICIENTS[i]) + above_below_tangential[i] for i in places
    }
    moved: FullParameters = p._replace(
        fx=p.fx * float(q[FOCAL].exp()),
        fy=p.fy * float((q[FOCAL] + q[ASPECT]).exp()),
        cx=p.cx + float(q[2]) * p.fx,
        cy=p.cy + float(q[3]) * p.fy,
        **coefficients,
    )
    return camera.with_lens(moved)


def increments_between(before: Camera, after: Camera, unit: Tensor) -> Tensor:
    """The increments [COLUMNS] that make one camera of the other; the inverse of `moved_camera`."""
    p, q = before.full(), after.full()
    increments = torch.zeros(COLUMNS, dtype=torch.float64)
    increments[FOCAL] = math.log(q.fx / p.fx)
    increments[ASPECT] = math.log(q.fy / p.fy) - math.log(q.fx / p.fx)
    increments[CENTRE] = torch.tensor([(q.cx - p.cx) / p.fx, (q.cy - p.cy) / p.fy])
    for i in _OF_FISHEYES if p.fisheye else _OF_OTHERS:
        name = _COEFFICIENTS[i]
        increments[DISTORTION.start + i] = (getattr(q, name) - getattr(p, name)) / float(unit[i])
    return increments
