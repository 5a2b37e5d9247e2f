"""Lens distortion and its inverse, for NumPy arrays and torch tensors alike: arithmetic only.

All lenses share one form. A viewing direction is put on a plane: by its slopes X/Z, Y/Z for a perspective lens, by
its angle from the axis, in radians and in its own direction, for a fisheye. With r the distance from the centre there,

    x' = x g(r²) + 2 p1 x y + p2 (r² + 2 x²) + sx1 r²
    y' = y g(r²) + 2 p2 x y + p1 (r² + 2 y²) + sy1 r²
    g(s) = (1 + a1 s + a2 s² + a3 s³ + a4 s⁴) / (1 + b1 s + b2 s² + b3 s³)

which is COLMAP's FULL_OPENCV with a = (k1, k2, k3), b = (k4, k5, k6) and its THIN_PRISM_FISHEYE with a = (k1, ..., k4)
and b = 0.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple, TypeVar

from biresnerf.geometry.camera.camera_models import FullParameters

# Newton doubles the digits at each step; lenses that do not fold inside the image need five or six.
NEWTON_STEPS = 20
# In units of the focal length: under 1e-9 px for any real camera.
NEWTON_DONE = 1e-13

# NumPy arrays or torch tensors; torch is not needed to load this.
Array = TypeVar("Array", bound=Any)


class Coefficients(NamedTuple):
    """Coefficients of the radial factor's numerator and denominator, and p1, p2, sx1, sy1.

    Each is a number or an array that fits the points. Trailing zeros, or pairs of the last four, may be left out.
    """

    above: Sequence[Any]
    below: Sequence[Any]
    tangential: Sequence[Any]


def coefficients_of(full: FullParameters) -> Coefficients:
    """The coefficients of either family of lenses in their common form, none left out: 4, 3 and 4."""
    across = (full.p1, full.p2, full.sx1, full.sy1)
    if full.fisheye:
        return Coefficients((full.k1, full.k2, full.k3, full.k4), (full.b1, full.b2, full.b3), across)
    below = (full.k4, full.k5, full.k6)
    return Coefficients((full.k1, full.k2, full.k3, 0.0), below, across)


def distort(x: Array, y: Array, c: Coefficients) -> tuple[Array, Array]:
    """Distorted positions, in focal lengths from the principal point, of positions on the plane."""
    s = x * x + y * y
    radial = _series(s, c.above)
    if c.below:
        radial = radial / _series(s, c.below)
    u, v = x * radial, y * radial
    if c.tangential:
        p1, p2 = c.tangential[:2]
        u, v = u + 2 * p1 * x * y + p2 * (s + 2 * x * x), v + 2 * p2 * x * y + p1 * (s + 2 * y * y)
    if len(c.tangential) > 2:
        u, v = u + c.tangential[2] * s, v + c.tangential[3] * s
    return u, v


def distort_jacobian(x: Array, y: Array, c: Coefficients) -> tuple[Array, Array, Array, Array]:
    """Derivatives of `distort`: of x' by x and by y, of y' by x and by y."""
    s = x * x + y * y
    radial, slope = _series(s, c.above), 2 * _series_slope(s, c.above)
    if c.below:
        below = _series(s, c.below)
        radial = radial / below
        slope = (slope - radial * 2 * _series_slope(s, c.below)) / below
    xx, xy, yy = radial + slope * x * x, slope * x * y, radial + slope * y * y
    if c.tangential:
        p1, p2 = c.tangential[:2]
        xx = xx + 2 * p1 * y + 6 * p2 * x
        xy = xy + 2 * p1 * x + 2 * p2 * y
        yy = yy + 2 * p2 * x + 6 * p1 * y
    yx = xy
    if len(c.tangential) > 2:
        sx, sy = 2 * c.tangential[2], 2 * c.tangential[3]
        xx, xy, yx, yy = xx + sx * x, xy + sx * y, yx + sy * x, yy + sy * y
    return xx, xy, yx, yy


def newton_step(x: Array, y: Array, to_x: Array, to_y: Array, c: Coefficients) -> tuple[Array, Array]:
    """The step to subtract from x, y so that they distort, to first order, to `to_x`, `to_y`."""
    now_x, now_y = distort(x, y, c)
    return solve(distort_jacobian(x, y, c), now_x - to_x, now_y - to_y)


def solve(jacobian: tuple[Array, Array, Array, Array], u: Array, v: Array) -> tuple[Array, Array]:
    """The inverse of a Jacobian as `distort_jacobian` gives it, applied to (u, v)."""
    xx, xy, yx, yy = jacobian
    determinant = xx * yy - xy * yx
    return (yy * u - xy * v) / determinant, (xx * v - yx * u) / determinant


def undistort(to_x: Array, to_y: Array, c: Coefficients) -> tuple[Array, Array]:
    """The inverse of `distort`: Newton's method in two unknowns, started at the distorted position."""
    x, y = to_x, to_y
    for _ in range(NEWTON_STEPS):
        step_x, step_y = newton_step(x, y, to_x, to_y, c)
        x, y = x - step_x, y - step_y
        if len(x) == 0 or float((abs(step_x) + abs(step_y)).max()) < NEWTON_DONE:
            break
    return x, y


def _series(s: Any, coefficients: Sequence[Any]) -> Any:
    """1 + c1 s + c2 s² + ..."""
    total: Any = 0.0
    for c in reversed(coefficients):
        total = (total + c) * s
    return total + 1.0


def _series_slope(s: Any, coefficients: Sequence[Any]) -> Any:
    """The derivative of `_series` by s."""
    total: Any = 0.0
    for power in range(len(coefficients), 0, -1):
        total = total * s + power * coefficients[power - 1]
    return total
