"""A synthetic neighbourhood from above: terrain, houses, roads and trees as functions of position.

Metres, z up. Everything follows from hashes of position and seed, so a square kilometre takes no memory, and photos are
the same on every machine.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from biresnerf.field.numba_kernels import njit, prange

PLOT = 30.0  # side of a plot, which holds a house or none
TREES = 9.0  # side of a square that holds a tree or none
ROAD = 7.0
HIGHEST = 26.0  # nothing reaches higher
LOWEST = -8.0
MARGIN = 12.0  # about what a photo shows: shadows come from there
_STEP = 0.35  # of a ray among roofs and trees
_SUN = (0.45, 0.35, 0.82)
_SHADOW = 0.45


@njit(cache=True, inline="always")
def _hash(i, j, salt):
    """A number from 0 to 1 for a place on a lattice."""
    h = np.uint32(i * 374761393 + j * 668265263 + salt * 974711)
    h = np.uint32((h ^ (h >> np.uint32(13))) * np.uint32(1274126177))
    h = np.uint32((h ^ (h >> np.uint32(15))) * np.uint32(2246822519))
    return float(h ^ (h >> np.uint32(16))) / 4294967296.0


@njit(cache=True)
def _noise(x, y, period, salt):
    """Smooth noise from -1 to 1 with hills about ``period`` wide."""
    x, y = x / period, y / period
    i, j = int(np.floor(x)), int(np.floor(y))
    u, v = x - i, y - j
    u, v = u * u * (3 - 2 * u), v * v * (3 - 2 * v)
    low = _hash(i, j, salt) * (1 - u) + _hash(i + 1, j, salt) * u
    high = _hash(i, j + 1, salt) * (1 - u) + _hash(i + 1, j + 1, salt) * u
    return 2 * (low * (1 - v) + high * v) - 1


@njit(cache=True)
def _terrain(x, y, seed):
    return 5 * _noise(x, y, 190.0, seed + 1) + 1.2 * _noise(x, y, 47.0, seed + 2)


@njit(cache=True)
def _is_road(x, y):
    i, j = int(np.floor(x / PLOT)), int(np.floor(y / PLOT))
    return (i % 3 == 0 and x - i * PLOT < ROAD) or (j % 2 == 0 and y - j * PLOT < ROAD)


@njit(cache=True)
def _house(x, y, seed):
    """Whether a house stands at a place, the height of its roof, and the distance from its ridge."""
    i, j = int(np.floor(x / PLOT)), int(np.floor(y / PLOT))
    if _hash(i, j, seed + 3) > 0.68:
        return False, 0.0, 0.0
    long, wide = 4.5 + 4 * _hash(i, j, seed + 4), 3.5 + 2.5 * _hash(i, j, seed + 5)
    cx, cy = (i + 0.6) * PLOT + 2 * _hash(i, j, seed + 6), (j + 0.6) * PLOT + 2 * _hash(i, j, seed + 7)
    a, b = x - cx, y - cy
    if _hash(i, j, seed + 8) < 0.5:
        a, b = b, a
    if abs(a) > long or abs(b) > wide:
        return False, 0.0, 0.0
    walls = 3.0 + 5.0 * _hash(i, j, seed + 9)
    slope = 0.15 + 0.6 * _hash(i, j, seed + 10)
    return True, _terrain(cx, cy, seed) + walls + slope * (wide - abs(b)), b


@njit(cache=True)
def _tree(x, y, seed):
    """Height of a crown above the ground, 0 where there is none."""
    i, j = int(np.floor(x / TREES)), int(np.floor(y / TREES))
    if _hash(i, j, seed + 11) > 0.4:
        return 0.0
    radius = 1.3 + 2.2 * _hash(i, j, seed + 12)
    cx, cy = (i + 0.5) * TREES, (j + 0.5) * TREES
    if _is_road(cx, cy):
        return 0.0
    inside = radius**2 - (x - cx) ** 2 - (y - cy) ** 2
    if inside <= 0:
        return 0.0
    return 1.2 * radius + 1.6 * np.sqrt(inside) + 0.35 * _noise(x, y, 0.9, seed + 13)


@njit(cache=True)
def surface_height(x, y, seed):
    house, roof, _ = _house(x, y, seed)
    ground = _terrain(x, y, seed)
    if house:
        return max(roof, ground)
    return ground + _tree(x, y, seed)


@njit(cache=True)
def _detail(x, y, seed, finest):
    """Noise at several scales, the finest visible in photos; mostly from -1 to 1."""
    value, weight, period = 0.0, 0.5, 8.0
    for octave in range(7):
        if period < finest:
            break
        value += weight * _noise(x, y, period, seed + 20 + octave)
        weight, period = weight * 0.82, period * 0.47
    return value


@njit(cache=True)
def _ground_colour(x, y, seed, finest):
    i, j = int(np.floor(x / PLOT)), int(np.floor(y / PLOT))
    grain = _detail(x, y, seed, finest)
    if _is_road(x, y):
        along = x if y - j * PLOT < ROAD and j % 2 == 0 else y
        across = (y - j * PLOT if y - j * PLOT < ROAD and j % 2 == 0 else x - i * PLOT) - ROAD / 2
        if abs(across) < 0.12 and along % 6.0 < 2.5:
            return 0.82, 0.82, 0.78
        grey = 0.34 + 0.10 * grain
        return grey, grey, grey * 1.03
    meadow = _noise(x, y, 23.0, seed + 30) + 0.5 * _noise(x, y, 6.0, seed + 31)
    if meadow > 0.45:  # gravel
        return 0.56 + 0.16 * grain, 0.51 + 0.15 * grain, 0.44 + 0.14 * grain
    dry = 0.5 + 0.5 * _noise(x, y, 11.0, seed + 32)
    return 0.26 + 0.20 * dry + 0.13 * grain, 0.36 + 0.06 * dry + 0.15 * grain, 0.16 + 0.08 * grain


@njit(cache=True)
def _roof_colour(x, y, slope, seed, finest):
    i, j = int(np.floor(x / PLOT)), int(np.floor(y / PLOT))
    warm, old = _hash(i, j, seed + 40), _hash(i, j, seed + 41)
    row = 0.05 * np.sin(2 * np.pi * slope / 0.7) if finest < 0.3 else 0.0
    shade = 0.16 * _detail(x, y, seed + 42, finest) + row + 0.15 * (old - 0.5)
    if abs(slope) < 0.2:
        shade += 0.12
    return 0.38 + 0.22 * warm + shade, 0.30 + 0.04 * warm + shade, 0.30 - 0.06 * warm + shade


@njit(cache=True)
def _wall_colour(x, y, z, seed, finest):
    i, j = int(np.floor(x / PLOT)), int(np.floor(y / PLOT))
    tone = 0.62 + 0.25 * _hash(i, j, seed + 50) + 0.1 * _detail(x + z, y - z, seed + 51, finest)
    if (x + y) % 2.6 < 1.0 and z % 2.8 > 1.2:  # windows
        return 0.22 + 0.1 * tone, 0.26 + 0.1 * tone, 0.32 + 0.1 * tone
    return tone, tone * 0.95, tone * 0.86


@njit(cache=True, parallel=True)
def _tops(x0, y0, columns, rows, seed):
    """An upper bound of the height in each 1 m cell from the corner (x0, y0) on, [rows, columns]."""
    raw = np.zeros((rows, columns))
    for row in prange(rows):
        for column in range(columns):
            top = -1e9
            for k in range(9):
                top = max(
                    top, surface_height(x0 + column + (k % 3 + 0.5) / 3, y0 + row + (k // 3 + 0.5) / 3, seed)
                )
            raw[row, column] = top
    tops = np.full((rows, columns), HIGHEST)
    for row in prange(1, rows - 1):
        for column in range(1, columns - 1):
            tops[row, column] = raw[row - 1 : row + 2, column - 1 : column + 2].max() + 0.1
    return tops


@njit(cache=True, inline="always")
def _top(x, y, tops, x0, y0):
    column, row = int(x - x0), int(y - y0)
    if x < x0 or y < y0 or row >= tops.shape[0] or column >= tops.shape[1]:
        return HIGHEST
    return tops[row, column]


@njit(cache=True)
def _meet(origin, direction, tops, x0, y0, seed):
    """Distance along a descending ray to the surface."""
    ox, oy, oz = origin[0], origin[1], origin[2]
    dx, dy, dz = direction[0], direction[1], direction[2]
    cell = 0.9 / max(abs(dx), abs(dy), 1e-9)  # not beyond the next cell, whose top this cell's includes
    t = before = max(0.0, (oz - HIGHEST) / -dz)
    while True:
        x, y, z = ox + t * dx, oy + t * dy, oz + t * dz
        above = z - _top(x, y, tops, x0, y0)
        if above > 0:
            before = t
            t += min(cell, above / -dz + 0.02)
            continue
        if z <= surface_height(x, y, seed):
            break
        before = t
        t += _STEP
    low, high = before, t
    for _ in range(5):
        t = 0.5 * (low + high)
        if oz + t * dz > surface_height(ox + t * dx, oy + t * dy, seed):
            low = t
        else:
            high = t
    return high


@njit(cache=True)
def _light(x, y, z, tops, x0, y0, seed):
    """The light on a surface point that is not on a wall: by its slope, and whether it is in shadow."""
    e = 0.15
    here = surface_height(x, y, seed)
    gx, gy = (surface_height(x + e, y, seed) - here) / e, (surface_height(x, y + e, seed) - here) / e
    gx, gy = min(max(gx, -2.0), 2.0), min(max(gy, -2.0), 2.0)
    light = max(0.15, (_SUN[2] - gx * _SUN[0] - gy * _SUN[1]) / np.sqrt(1 + gx * gx + gy * gy))
    for k in range(1, 10):
        s = 0.4 + 1.3 * k
        xs, ys, zs = x + s * _SUN[0], y + s * _SUN[1], z + s * _SUN[2]
        if zs < _top(xs, ys, tops, x0, y0) and zs < surface_height(xs, ys, seed):
            return _SHADOW * light
    return light


@njit(cache=True)
def _colour(origin, direction, tops, x0, y0, seed, pixel):
    """The colour that a ray sees, and its distance; ``pixel`` is the angle of a pixel."""
    t = _meet(origin, direction, tops, x0, y0, seed)
    x, y, z = origin[0] + t * direction[0], origin[1] + t * direction[1], origin[2] + t * direction[2]
    finest = 2 * t * pixel
    house, _, slope = _house(x, y, seed)
    if house and z < surface_height(x, y, seed) - 0.4:
        r, g, b = _wall_colour(x, y, z, seed, finest)
        return 0.62 * r, 0.62 * g, 0.62 * b, t
    light = _light(x, y, z, tops, x0, y0, seed)
    if house:
        r, g, b = _roof_colour(x, y, slope, seed, finest)
    elif _tree(x, y, seed) > 0:
        leaf = _detail(x, y, seed + 60, finest)
        r, g, b = 0.20 + 0.12 * leaf, 0.32 + 0.16 * leaf, 0.13 + 0.07 * leaf
    else:
        r, g, b = _ground_colour(x, y, seed, finest)
    return r * light, g * light, b * light, t


@njit(cache=True, parallel=True)
def _trace(world_from_cam, width, height, focal, tops, x0, y0, seed, samples):
    photo = np.zeros((height, width, 3), np.float32)
    depth = np.zeros((height, width), np.float32)
    origin = world_from_cam[:3, 3].copy()
    for row in prange(height):
        direction = np.zeros(3)
        for column in range(width):
            for k in range(samples * samples):
                x = (column + (k % samples + 0.5) / samples - width / 2) / focal
                y = (row + (k // samples + 0.5) / samples - height / 2) / focal
                length = np.sqrt(x * x + y * y + 1)
                for axis in range(3):
                    along = (
                        world_from_cam[axis, 0] * x + world_from_cam[axis, 1] * y + world_from_cam[axis, 2]
                    )
                    direction[axis] = along / length
                r, g, b, t = _colour(origin, direction, tops, x0, y0, seed, 1 / focal)
                photo[row, column, 0] += r / samples**2
                photo[row, column, 1] += g / samples**2
                photo[row, column, 2] += b / samples**2
                depth[row, column] = t / length
    return photo, depth


def render(
    world_from_cam: NDArray[np.float64], width: int, height: int, focal: float, seed: int, samples: int = 2
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """One photo of a centred pinhole camera that looks down.

    Returns:
        linear colours [height, width, 3], each pixel the mean of ``samples`` x ``samples`` rays, and the depth along
        the optical axis (m) of the last of these [height, width].
    """
    corners = np.array([[x * width, y * height, 2 * focal] for x in (-1, 1) for y in (-1, 1)], float)
    rays = corners @ world_from_cam[:3, :3].T
    origin = world_from_cam[:3, 3]
    seen = origin + rays * ((LOWEST - origin[2]) / rays[:, 2:])
    low = np.minimum(seen.min(0), origin)[:2] - MARGIN
    size = np.ceil(np.maximum(seen.max(0), origin)[:2] + MARGIN - low).astype(int)
    tops = _tops(low[0], low[1], size[0], size[1], seed)
    photo, depth = _trace(world_from_cam, width, height, focal, tops, low[0], low[1], seed, samples)
    return photo, depth
