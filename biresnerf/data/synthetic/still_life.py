"""A still life of wood, brick, marble, cloth, glazed clay and a lettered book, in soft light: it looks like a photo.

Surfaces and poses are as exactly known as those of `scene.py`; only colour and light are richer.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from biresnerf.data.synthetic.camera_photos import Maker
from biresnerf.data.synthetic.scene import (
    render_shapes,
    synthetic_cameras,
    synthetic_focal,
    write_blender_set,
)
from biresnerf.data.synthetic.shapes import Shape

Array = NDArray[np.float32]
# Points and normals [n, 3] in a shape's own frame -> colours [n, 3].
Pattern = Callable[[Array, Array], Array]

STILL_LIFE = (
    Shape("box", (0.0, 0.0, -0.50), (0.98, 0.84, 0.07), (8.0, 0.0)),
    Shape("box", (0.06, -0.10, -0.42), (0.78, 0.52, 0.012), (-14.0, 0.0)),
    Shape("box", (-0.48, 0.36, -0.02), (0.30, 0.24, 0.41), (24.0, 0.0)),
    Shape("sphere", (0.50, -0.28, -0.13), (0.28, 0.28, 0.28), (0.0, 0.0)),
    Shape("box", (-0.30, -0.36, -0.335), (0.38, 0.27, 0.075), (-32.0, 0.0)),
    Shape("cylinder", (0.32, 0.36, -0.07), (0.23, 0.23, 0.36), (0.0, 0.0)),
    Shape("sphere", (0.32, 0.36, 0.28), (0.23, 0.23, 0.23), (0.0, 0.0)),
    Shape("cylinder", (0.32, 0.36, 0.57), (0.12, 0.12, 0.12), (0.0, 0.0)),
    Shape("sphere", (-0.34, -0.34, -0.13), (0.13, 0.13, 0.13), (0.0, 0.0)),
    Shape("cylinder", (0.02, 0.10, -0.24), (0.12, 0.12, 0.17), (30.0, 0.0)),
)
_SKY, _LAMP = 0.62, 0.66  # shares of the light
_LAMP_FROM = np.array([0.45, -0.40, 0.80], np.float32)
_LAMP_SIZE, _RAYS = 0.30, 16  # its radius at distance 1, and rays to it and to the sky
_CELL = 0.06  # of the grid that holds how much light arrives, scene units
_LOW, _HIGH = np.array([-1.14, -1.14, -0.66], np.float32), np.array([1.14, 1.14, 0.84], np.float32)
_WOOD, _PALE_WOOD = ((0.64, 0.43, 0.25), (0.40, 0.23, 0.12)), ((0.83, 0.68, 0.46), (0.68, 0.49, 0.28))


def write_still_life(folder: Path, n_views: int, size: int, seed: int, maker: Maker | None = None) -> Path:
    """Writes square cut-out views of the still life and transforms.json (Blender dialect, true poses).

    Args:
        seed: of the cameras; the things are always the same.

    Returns:
        the path of transforms.json, written last.
    """
    poses = synthetic_cameras(n_views, seed)
    focal = synthetic_focal(size)
    surfaces = still_life_surfaces()
    pictures = (render_shapes(STILL_LIFE, surfaces, pose, size, size, focal)[0] for pose in poses)
    return write_blender_set(folder, poses, pictures, "still_life", maker)


def still_life_surfaces() -> list[Surface]:
    """The surfaces of `STILL_LIFE`, in its order."""
    light = Light(STILL_LIFE)
    patterns: list[Pattern] = [
        _wood(*_WOOD, seed=1), _Cloth(), _bricks, _marble, _Book(), _glaze, _glaze, _glaze, _orange,
        _wood(*_PALE_WOOD, seed=2),
    ]  # fmt: skip
    return [Surface(shape, pattern, light) for shape, pattern in zip(STILL_LIFE, patterns, strict=True)]


@dataclass(frozen=True, eq=False)
class Surface:
    """What a shape looks like: a pattern in its own frame, and the light that arrives."""

    shape: Shape
    pattern: Pattern
    light: Light

    def colour(self, points: Array, normals: Array) -> Array:
        """Lit colours float32 [points, 3], 0 to 1."""
        rotation = self.shape.world_from_shape
        own = (points - np.asarray(self.shape.centre, np.float32)) @ rotation
        plain = np.clip(self.pattern(own, normals @ rotation), 0.02, 1.0)
        return np.clip(plain * self.light.at(points, normals)[:, None], 0.0, 1.0).astype(np.float32)


@dataclass(frozen=True, eq=False)
class Light:
    """A lamp as wide as a window and a bright sky, less what the shapes keep off: soft shadows."""

    shapes: Sequence[Shape]

    def at(self, points: Array, normals: Array) -> Array:
        """Light on surfaces [points]; about 1 in full light."""
        lamp, sky = self._arriving(points + 1.2 * _CELL * normals).T
        towards = np.maximum(normals @ (_LAMP_FROM / np.linalg.norm(_LAMP_FROM)), 0)
        lit: Array = _SKY * sky * (0.65 + 0.35 * normals[:, 2]) + _LAMP * lamp * (0.15 + 0.85 * towards)
        return lit

    def _arriving(self, points: Array) -> Array:
        """Shares [points, 2] of lamp and sky that are seen from there, between the grid's points."""
        grid = self._grid
        place = np.clip((points - _LOW) / _CELL, 0, np.array(grid.shape[:3]) - 1.001)
        low = place.astype(np.int64)
        share = (place - low).astype(np.float32)
        total = np.zeros((len(points), 2), np.float32)
        for corner in np.ndindex(2, 2, 2):
            weight = np.prod(np.where(corner, share, 1 - share), axis=1)
            total += weight[:, None] * grid[tuple((low + corner).T)]
        return total

    @cached_property
    def _grid(self) -> Array:
        axes = [np.arange(low, high, _CELL, dtype=np.float32) for low, high in zip(_LOW, _HIGH, strict=True)]
        places = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
        points = places.reshape(-1, 3)
        turns = np.arange(_RAYS) * np.pi * (3 - np.sqrt(5))
        radii = np.sqrt((np.arange(_RAYS) + 0.5) / _RAYS)
        disc = np.stack([radii * np.cos(turns), radii * np.sin(turns), np.zeros(_RAYS)], axis=1)
        lamp = _LAMP_FROM + _LAMP_SIZE * disc
        sky = np.stack([disc[:, 0], disc[:, 1], np.sqrt(1.001 - radii**2)], axis=1)
        shares = np.stack([self._open(points, rays) for rays in (lamp, sky)], axis=1)
        return shares.reshape(*places.shape[:3], 2)

    def _open(self, points: Array, rays: NDArray[np.floating]) -> Array:
        """The share [points] of rays that meet no shape. All rays are parallel, so one turn serves all points."""
        share = np.zeros(len(points), np.float32)
        for ray in (rays / np.linalg.norm(rays, axis=1, keepdims=True)).astype(np.float32):
            free = np.ones(len(points), bool)
            for shape in self.shapes:
                free &= ~_meets(shape, points, ray)
            share += free
        return share / np.float32(len(rays))


def _meets(shape: Shape, points: Array, ray: Array) -> NDArray[np.bool_]:
    """Whether a ray from each point [n, 3] along one direction [3] meets a shape; those within it do."""
    rotation = shape.world_from_shape
    origins, along = (points - np.asarray(shape.centre, np.float32)) @ rotation, ray @ rotation
    size = np.asarray(shape.size, np.float32)
    if shape.kind == "sphere":
        b = origins @ along
        under_root = b * b - ((origins**2).sum(axis=1) - size[0] ** 2)
        return (under_root > 0) & (-b + np.sqrt(np.maximum(under_root, 0)) > 0)
    along = np.where(np.abs(along) < 1e-6, np.float32(1e-6), along)
    near, far = (-np.sign(along) * size - origins) / along, (np.sign(along) * size - origins) / along
    if shape.kind == "box":
        enter, leave = near.max(axis=1), far.min(axis=1)
        return (enter < leave) & (leave > 0)
    a, b = (along[:2] ** 2).sum(), origins[:, :2] @ along[:2]
    under_root = b * b - a * ((origins[:, :2] ** 2).sum(axis=1) - size[0] ** 2)
    root = np.sqrt(np.maximum(under_root, 0))
    enter, leave = np.maximum((-b - root) / a, near[:, 2]), np.minimum((-b + root) / a, far[:, 2])
    return (under_root > 0) & (enter < leave) & (leave > 0)


def _mixed(first: Sequence[float], second: Sequence[float], share: NDArray[np.floating]) -> Array:
    """Between two colours, by a share [n] of the second."""
    part = np.clip(share, 0, 1)[:, None].astype(np.float32)
    return np.asarray(first, np.float32) * (1 - part) + np.asarray(second, np.float32) * part


def _cloudy(points: Array, seed: int, first: float, octaves: int = 4) -> Array:
    """Smooth noise [n] of about -1 to 1: sums of waves in many directions, each octave half as strong."""
    rng = np.random.default_rng([seed, 12])
    total = np.zeros(len(points), np.float32)
    for octave in range(octaves):
        directions = rng.normal(size=(5, 3))
        directions *= first * 2**octave / np.linalg.norm(directions, axis=1, keepdims=True)
        phases = rng.uniform(0, 2 * np.pi, 5)
        waves = np.sin(points @ directions.T.astype(np.float32) + phases.astype(np.float32))
        total += waves.sum(axis=1) * np.float32(0.28 * 0.5**octave)
    return total


def _wood(light: Sequence[float], dark: Sequence[float], seed: int) -> Pattern:
    """Planks along x, each with rings and fibres of its own."""

    def colour(points: Array, normals: Array) -> Array:
        plank = np.floor((points[:, 1] + 2) / 0.31)
        moved = points + plank[:, None] * np.array([1.7, 0.4, 0.9], np.float32)
        bent = moved * np.array([0.22, 1, 1], np.float32)
        rings = np.hypot(bent[:, 1] + 0.25, bent[:, 2] + 0.6) * 26 + 1.6 * _cloudy(bent, seed, 3.0)
        fibres = _cloudy(moved * np.array([0.12, 1, 1], np.float32), seed + 50, 55.0, 2)
        share = 0.32 + 0.30 * np.sin(rings) + 0.16 * fibres + 0.14 * np.sin(2.3 * plank)
        gap = np.abs((points[:, 1] + 2) / 0.31 - plank - 0.5) > 0.485
        return _mixed(light, dark, share) * np.where(gap, 0.45, 1.0)[:, None].astype(np.float32)

    return colour


def _across(points: Array, normals: Array) -> tuple[Array, Array]:
    """Coordinates along a box's side and up it, of points on its sides; of those on its top, along x and y."""
    axis = np.abs(normals).argmax(axis=1)
    along = np.where(axis == 0, points[:, 1] + 7.0, points[:, 0])
    return along, np.where(axis == 2, points[:, 1], points[:, 2])


def _bricks(points: Array, normals: Array) -> Array:
    along, up = _across(points, normals)
    row = np.floor((up + 3) / 0.117)
    moved = along + 0.105 * (row % 2)
    column = np.floor(moved / 0.21)
    edge = np.minimum(_to_next(moved, 0.21), _to_next(up + 3, 0.117))
    grain = _cloudy(points, 3, 18.0)
    own = np.sin(row * 12.9898 + column * 78.233) * 43758.5453
    brick = _mixed((0.66, 0.30, 0.20), (0.42, 0.17, 0.13), 0.75 * (own - np.floor(own)) + 0.22 * grain)
    mortar = _mixed((0.78, 0.74, 0.68), (0, 0, 0), 0.10 + 0.10 * grain)
    return np.where((edge < 0.010)[:, None], mortar, brick)


def _to_next(places: Array, step: float) -> Array:
    """Distance [n] to the nearest multiple of a step."""
    whole: Array = np.abs(places / step - np.round(places / step)) * np.float32(step)
    return whole


def _marble(points: Array, normals: Array) -> Array:
    bent = points @ np.array([5.0, 3.0, 4.0], np.float32) + 2.6 * _cloudy(points, 5, 4.0)
    veins = (1 - np.abs(np.sin(bent))) ** 6 + 0.5 * (1 - np.abs(np.sin(2.7 * bent + 1))) ** 8
    return _mixed((0.93, 0.92, 0.89), (0.30, 0.33, 0.36), veins + 0.07 * _cloudy(points, 6, 9.0))


def _glaze(points: Array, normals: Array) -> Array:
    """Blue-green, darker where it ran down, with two painted bands and a wave between."""
    around = np.arctan2(points[:, 1], points[:, 0])
    ran = _cloudy(points * np.array([1, 1, 0.25], np.float32), 8, 14.0)
    base = _mixed((0.20, 0.46, 0.50), (0.10, 0.27, 0.36), 0.45 + 0.45 * ran)
    wave = np.abs(points[:, 2] - 0.045 * np.sin(7 * around) - 0.03 * np.sin(3 * around + 1)) < 0.022
    band = np.abs(np.abs(points[:, 2]) - 0.105) < 0.012
    return np.where((wave | band)[:, None], np.array([0.90, 0.84, 0.70], np.float32), base)


def _orange(points: Array, normals: Array) -> Array:
    return _mixed((0.93, 0.53, 0.12), (0.80, 0.36, 0.06), 0.35 + 0.5 * _cloudy(points, 9, 30.0, 3))


class _Printed:
    """A picture on the top of a box of such half sides."""

    def __init__(self, picture: Image.Image, half: tuple[float, float]) -> None:
        self._pixels = np.asarray(picture.convert("RGB"), np.float32) / 255
        self._half = half

    def colour(self, points: Array) -> Array:
        rows, columns = self._pixels.shape[:2]
        x = np.clip((points[:, 0] / self._half[0] + 1) / 2 * columns, 0, columns - 1).astype(np.int64)
        y = np.clip((1 - points[:, 1] / self._half[1]) / 2 * rows, 0, rows - 1).astype(np.int64)
        return self._pixels[y, x]


class _Book:
    """Red cloth with a title, and paper between the covers."""

    def __init__(self) -> None:
        picture = Image.new("RGB", (760, 540), (140, 32, 36))
        draw = ImageDraw.Draw(picture)
        draw.rectangle((26, 26, 733, 513), outline=(222, 186, 110), width=7)
        for text, y, size in (("A FIELD", 80, 128), ("OF VIEW", 215, 128), ("poses & light", 385, 66)):
            draw.text((380, y), text, (236, 205, 132), ImageFont.load_default(size), anchor="ma")
        self._cover = _Printed(picture, (0.38, 0.27))

    def __call__(self, points: Array, normals: Array) -> Array:
        top = normals[:, 2] > 0.5
        cover = self._cover.colour(points) * (1 + 0.08 * _cloudy(points, 11, 60.0, 2))[:, None]
        pages = (np.abs(points[:, 2]) < 0.058) & (points[:, 0] > -0.3799)
        paper = _mixed((0.93, 0.90, 0.80), (0.70, 0.66, 0.55), 0.5 + 0.5 * np.sin(points[:, 2] * 420))
        side = np.where(pages[:, None], paper, np.array([0.50, 0.11, 0.13], np.float32))
        return np.where(top[:, None], cover, side).astype(np.float32)


class _Cloth:
    """A woven runner: white linen with blue stripes of uneven width."""

    def __call__(self, points: Array, normals: Array) -> Array:
        weave = 0.5 + 0.5 * np.sin(points[:, 0] * 150) * np.sin(points[:, 1] * 150)
        long = np.abs(points[:, 1])
        striped = np.zeros(len(points), bool)
        for near, far in ((0.30, 0.36), (0.39, 0.41), (0.44, 0.46)):
            striped |= (long > near) & (long < far)
        cross = (np.abs(np.abs(points[:, 0]) - 0.62) < 0.035) | (np.abs(np.abs(points[:, 0]) - 0.69) < 0.012)
        linen = _mixed((0.92, 0.89, 0.82), (0.80, 0.76, 0.67), 0.5 * weave + 0.35 * _cloudy(points, 13, 10.0))
        blue = _mixed((0.20, 0.32, 0.56), (0.12, 0.20, 0.40), weave)
        return np.where((striped | cross)[:, None], blue, linen).astype(np.float32)
