"""COLMAP's lenses of other formulas, each carried by the lens of our two families that matches it over its photo.

Such a lens is a curve: how far from the principal point, in focal lengths, it shows what lies at an angle from its
axis. `distortion` has curves with six or seven coefficients, one of which fits it more closely than a photo can show;
the lens's own parameters stay with the camera. The formulas are those of COLMAP's src/colmap/sensor/models.h, after
Devernay and Faugeras 2001 (FOV), Khomutenko et al. 2016 (EUCM) and Fitzgibbon 2001 (DIVISION).
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from biresnerf.arrays import Array

# What each has beside focal lengths and the principal point.
SHAPES = {"FOV": ("omega",), "SIMPLE_DIVISION": ("k",), "DIVISION": ("k",), "EUCM": ("alpha", "beta")}
# A photo that shows nothing farther from the axis is carried by a perspective lens: more is adjusted of those.
PERSPECTIVE_DEG = 50.0
_ANGLES, _SAMPLES = 20_000, 300
_LEAST_OMEGA = 1e-6  # less is a pinhole, to rounding
_REWEIGHTED = 20
_STEPS, _SETTLED, _DIFFERENCE = 30, 1e-12, 1e-5


class Curve(NamedTuple):
    """A curve of the form in `biresnerf.geometry.camera.distortion`: distances from the principal point by angle.

    Attributes:
        focal: in units of those of the distances.
        above, below: coefficients of the radial factor's numerator and denominator.
        fisheye: whether positions on the plane are angles, not slopes.
    """

    focal: float
    above: tuple[float, ...]
    below: tuple[float, ...]
    fisheye: bool

    def at(self, angle: Array) -> Array:
        """Distances at angles (rad) from the axis."""
        on_plane = angle if self.fisheye else np.tan(angle)
        above, below = (np.polyval((*c[::-1], 1.0), on_plane**2) for c in (self.above, self.below))
        return np.asarray(self.focal * on_plane * above / below)


class Carrier(NamedTuple):
    """The curve that represents a lens over its photo.

    Attributes:
        curve: in focal lengths of the lens.
        apart: largest deviation from the lens's own curve, in its focal lengths.
        angles: [n], rad from the axis, out to the photo's farthest corner.
    """

    curve: Curve
    apart: float
    angles: Array


@lru_cache(maxsize=256)
def carrier_of(model: str, shape: tuple[float, ...], corner: float) -> Carrier:
    """The curve that carries a lens whose photo's farthest corner is `corner` focal lengths from the principal point.

    Raises:
        ValueError: the lens shows nothing there.
    """
    angles = np.linspace(0.0, np.pi, _ANGLES + 1)[1:]
    with np.errstate(invalid="ignore"):
        rises = np.diff(_distances(model, shape, angles), prepend=0.0) > 0
    seen = angles if rises.all() else angles[: int(np.argmin(rises))]
    end = int(np.searchsorted(_distances(model, shape, seen), corner))
    if end == len(seen):
        raise ValueError(f"this {model} lens shows nothing in the photo's corners")
    angles = np.linspace(0.0, float(seen[end]), _SAMPLES + 1)[1:]
    fisheye = bool(np.degrees(angles[-1]) > PERSPECTIVE_DEG)
    curve = fitted_curve(angles, _distances(model, shape, angles), 4 if fisheye else 3, 3, fisheye=fisheye)
    between = angles - angles[0] / 2
    apart = np.abs(curve.at(between) - _distances(model, shape, between)).max()
    return Carrier(curve, float(apart), angles)


def fitted_curve(angles: Array, distances: Array, above: int, below: int, *, fisheye: bool) -> Curve:
    """The curve with so many coefficients that is nearest to distances [n] at angles [n] (rad).

    Least squares times the denominator are linear; each round is weighted by the last one, until it converges.
    """
    on_plane = angles if fisheye else np.tan(angles)
    powers = on_plane[:, None] ** (2 * np.arange(max(above, below) + 1))
    columns = np.hstack(
        [powers[:, : above + 1] * on_plane[:, None], -powers[:, 1 : below + 1] * distances[:, None]]
    )
    size = np.linalg.norm(columns, axis=0)
    under = np.ones_like(distances)
    for _ in range(_REWEIGHTED if below else 1):
        weighted = columns / size / under[:, None]
        c = np.linalg.lstsq(weighted, distances / under, rcond=1e-13)[0] / size
        under = 1.0 + powers[:, 1 : below + 1] @ c[above + 1 :]
    focal, *rest = c.tolist()
    return Curve(focal, tuple(value / focal for value in rest[:above]), tuple(rest[above:]), fisheye)


def nearest_shape(
    model: str, start: tuple[float, ...], angles: Array, distances: Array
) -> tuple[float, tuple[float, ...], float]:
    """Focal length and shape of the lens nearest to distances [n] at angles [n] (rad), and how far it is at most.

    Gauss and Newton's method from the shape `start`. The focal length and the last have the distances' unit.
    """
    values = np.array(start)
    focal = float(np.median(distances / _distances(model, start, angles)))
    for _ in range(_STEPS):
        columns = [_distances(model, values, angles)]
        for change in np.eye(len(values)) * _DIFFERENCE:
            more, less = (_distances(model, values + sign * change, angles) for sign in (1, -1))
            columns.append(focal * (more - less) / (2 * _DIFFERENCE))
        if not np.isfinite(columns).all():
            break
        step = np.linalg.lstsq(np.stack(columns, 1), distances - focal * columns[0], rcond=None)[0]
        focal, values = focal + float(step[0]), values + step[1:]
        if np.abs(step[1:]).max() < _SETTLED:
            break
    away = np.abs(focal * _distances(model, values, angles) - distances).max()
    return focal, tuple(values.tolist()), float(away)


def _distances(model: str, shape: Sequence[float] | Array, angles: Array) -> Array:
    """How far from the principal point, in focal lengths, a lens shows what lies at angles from its axis; else NaN."""
    across, along = np.sin(angles), np.cos(angles)
    with np.errstate(invalid="ignore", divide="ignore"):
        if model == "FOV":
            omega = max(abs(float(shape[0])), _LEAST_OMEGA)
            shown = np.arctan(2 * np.tan(omega / 2) * across / along) / omega
            return np.where(along > 0, shown, np.nan)
        if model == "EUCM":
            alpha, beta = shape
            depth = alpha * np.sqrt(beta * across**2 + along**2) + (1 - alpha) * along
            return np.asarray(across / np.where(depth > 0, depth, np.nan))
        return np.asarray(2 * across / (along + np.sqrt(along**2 - 4 * shape[0] * across**2)))
