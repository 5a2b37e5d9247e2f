"""Opaque textured shapes with exact ray intersections: what the synthetic scene is made of."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float32]
_FAR = np.float32(1e9)
# Wave numbers of the texture (rad per scene unit): from patches as large as a shape to details of a few
# pixels.
_WAVE_NUMBERS = (2.5, 5.0, 10.0, 20.0, 36.0)
_WAVES_EACH = 3
_LIGHT = np.array([0.43, -0.30, 0.85], dtype=np.float32)


class Hit(NamedTuple):
    """Distances along the rays ([rays], 1e9 for a miss) and the surface's outward normals [rays, 3]."""

    distance: Array
    normal: Array


@dataclass(frozen=True, eq=False)
class Shape:
    """A sphere, box or cylinder (about its z axis): ``size`` holds its three half axes in its own frame.

    A sphere takes its radius from ``size[0]``, a cylinder its radius from ``size[0]`` and half height from
    ``size[2]``. A room is a sphere seen from within.
    """

    kind: Literal["sphere", "box", "cylinder", "room"]
    centre: tuple[float, float, float]
    size: tuple[float, float, float]
    turn_deg: tuple[float, float]  # about the world's z axis, then about the shape's own x axis

    @property
    def world_from_shape(self) -> Array:
        """Rotation [3, 3]."""
        a, b = np.radians(self.turn_deg)
        about_z = np.array([[np.cos(a), -np.sin(a), 0], [np.sin(a), np.cos(a), 0], [0, 0, 1]])
        about_x = np.array([[1, 0, 0], [0, np.cos(b), -np.sin(b)], [0, np.sin(b), np.cos(b)]])
        return (about_z @ about_x).astype(np.float32)

    @property
    def bounding_radius(self) -> float:
        """Radius of a sphere about ``centre`` that holds the shape."""
        if self.kind in ("sphere", "room"):
            return self.size[0]
        if self.kind == "cylinder":
            return float(np.hypot(self.size[0], self.size[2]))
        return float(np.linalg.norm(self.size))

    def intersect(self, origin_in_world: Array, directions_in_world: Array) -> Hit:
        """First crossings by rays from one origin [3] along unit vectors [rays, 3]: from outside, a room's within."""
        rotation = self.world_from_shape
        origin = (origin_in_world - np.asarray(self.centre, np.float32)) @ rotation
        directions = directions_in_world @ rotation
        size = np.asarray(self.size, np.float32)
        solve = {"sphere": _sphere, "box": _box, "cylinder": _cylinder, "room": _room}[self.kind]
        distance, normal = solve(origin, directions, size)
        return Hit(distance, normal @ rotation.T)


def _sphere(origin: Array, directions: Array, size: Array) -> tuple[Array, Array]:
    b = directions @ origin
    under_root = b * b - (origin @ origin - size[0] ** 2)
    hit = (under_root > 0) & (b < 0)
    distance = np.where(hit, -b - np.sqrt(np.maximum(under_root, 0)), _FAR)
    return distance, (origin + distance[:, None] * directions) / size[0]


def _room(origin: Array, directions: Array, size: Array) -> tuple[Array, Array]:
    b = directions @ origin
    distance = -b + np.sqrt(np.maximum(b * b - (origin @ origin - size[0] ** 2), 0))
    return distance, -(origin + distance[:, None] * directions) / size[0]


def _box(origin: Array, directions: Array, size: Array) -> tuple[Array, Array]:
    safe = np.where(np.abs(directions) < 1e-9, np.float32(1e-9), directions)
    near = (-np.sign(safe) * size - origin) / safe
    far = (np.sign(safe) * size - origin) / safe
    axis = near.argmax(axis=1)
    enter, leave = near.max(axis=1), far.min(axis=1)
    distance = np.where((enter < leave) & (enter > 0), enter, _FAR)
    normal = np.zeros_like(directions)
    rows = np.arange(len(directions))
    normal[rows, axis] = -np.sign(safe[rows, axis])
    return distance, normal


def _cylinder(origin: Array, directions: Array, size: Array) -> tuple[Array, Array]:
    radius, half = size[0], size[2]
    a = np.maximum((directions[:, :2] ** 2).sum(axis=1), 1e-12)
    b = directions[:, :2] @ origin[:2]
    under_root = b * b - a * (origin[:2] @ origin[:2] - radius**2)
    root = np.sqrt(np.maximum(under_root, 0))
    z = np.where(np.abs(directions[:, 2]) < 1e-9, np.float32(1e-9), directions[:, 2])
    cap_near, cap_far = (-np.sign(z) * half - origin[2]) / z, (np.sign(z) * half - origin[2]) / z
    side_near, side_far = (-b - root) / a, (-b + root) / a
    enter, leave = np.maximum(side_near, cap_near), np.minimum(side_far, cap_far)
    hit = (under_root > 0) & (enter < leave) & (enter > 0)
    distance = np.where(hit, enter, _FAR)
    on_side = side_near > cap_near
    normal = np.zeros_like(directions)
    point = origin[:2] + distance[:, None] * directions[:, :2]
    normal[:, :2] = np.where(on_side[:, None], point / radius, 0)
    normal[:, 2] = np.where(on_side, 0, -np.sign(z))
    return distance, normal


def _waves(
    rng: np.random.Generator, scales: int
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Wave numbers [waves], directions [waves, 3] and colours [waves, 3] of unit length."""
    numbers = np.repeat(_WAVE_NUMBERS[:scales], _WAVES_EACH)
    directions, tints = rng.normal(size=(2, len(numbers), 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    tints /= np.linalg.norm(tints, axis=1, keepdims=True)
    return numbers, directions, tints


@dataclass(frozen=True, eq=False)
class Texture:
    """Colour as a function of the point: two base colours with a curved edge between, and waves."""

    bases: Array  # [2, 3]
    split: Array  # [2, 3] wave vectors whose product's sign chooses the base
    waves: Array  # [waves, 3] wave vectors (rad per unit)
    phases: Array  # [waves]
    amplitudes: Array  # [waves, 3]

    @staticmethod
    def random(rng: np.random.Generator, scales: int = len(_WAVE_NUMBERS)) -> Texture:
        """A texture that no other draw resembles, of so many scales of detail, from the coarsest on."""
        numbers, directions, tints = _waves(rng, scales)
        amplitudes = 0.20 * tints * (numbers[:, None] / _WAVE_NUMBERS[0]) ** -0.25
        first = rng.uniform(0.15, 0.85, 3)
        parts = (
            np.stack([first, 1.0 - first]),
            rng.normal(size=(2, 3)) * 4.0,
            directions * numbers[:, None],
            rng.uniform(0, 2 * np.pi, len(numbers)),
            amplitudes,
        )
        return Texture(*(part.astype(np.float32) for part in parts))

    @staticmethod
    def glaze(rng: np.random.Generator, base: tuple[float, float, float], contrast: float) -> Texture:
        """One colour (0 to 1) that varies slowly by `contrast`, without any edge: next to nothing for features."""
        numbers, directions, tints = _waves(rng, 2)
        parts = (
            np.array([base, base]),
            np.zeros((2, 3)),
            directions * numbers[:, None],
            rng.uniform(0, 2 * np.pi, len(numbers)),
            contrast * tints,
        )
        return Texture(*(part.astype(np.float32) for part in parts))

    def colour(self, points: Array, normals: Array) -> Array:
        """Lit colours float32 [points, 3], 0 to 1."""
        sides = np.sin(points @ self.split[0]) * np.cos(points @ self.split[1]) > 0
        plain = self.bases[sides.astype(np.int64)]
        plain += np.sin(points @ self.waves.T + self.phases) @ self.amplitudes
        light = 0.68 + 0.32 * np.maximum(normals @ (_LIGHT / np.linalg.norm(_LIGHT)), 0)
        return np.clip(np.clip(plain, 0.02, 1.0) * light[:, None], 0.0, 1.0)
