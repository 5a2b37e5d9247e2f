"""What cameras are adjusted to, and how well they are known before."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from biresnerf.arrays import Array
from biresnerf.data.points.tracks import Tracks
from biresnerf.geometry.camera.camera import Intrinsics
from biresnerf.geometry.focus import rms_spread
from biresnerf.geometry.rigid_bodies import RigidBodies
from biresnerf.refinement.adjustment.lens.lenses import Lenses
from biresnerf.refinement.adjustment.splines import blurred, spline_coefficients
from biresnerf.refinement.numbers.finish import EvidenceNumbers

EXACT = 1e-5  # of the spread of control points: no coordinates are more exact


@dataclass(frozen=True, eq=False)
class Patches:
    """Small patches of photos on the surface that the field sees there, and the photos that should show them as well.

    Attributes:
        host: int64 [p], the photo that each patch was taken from.
        rays: float64 [p, k, 3], of its pixels in the host camera's axes, z = 1.
        inverse_depth: float64 [p, k], along z, in the inverse of the poses' unit; its scale is estimated anew.
        point: int64 [m], ascending: the patch of each comparison.
        target: int64 [m], the photo that it is compared with.
        photos: the photos, see `PatchPhotos`.
    """

    host: NDArray[np.int64]
    rays: Array
    inverse_depth: Array
    point: NDArray[np.int64]
    target: NDArray[np.int64]
    photos: PatchPhotos

    def __len__(self) -> int:
        return len(self.host)

    def of(self, chosen: NDArray[np.bool_]) -> Patches:
        """The chosen [p] patches alone."""
        kept = chosen[self.point]
        number = np.cumsum(chosen) - 1
        return Patches(
            self.host[chosen], self.rays[chosen], self.inverse_depth[chosen],
            number[self.point[kept]], self.target[kept], self.photos,
        )  # fmt: skip


@dataclass(frozen=True, eq=False)
class PatchPhotos:
    """Photos of an ideal pinhole camera, row by row, one after the other.

    Attributes:
        values: float32 [total_px, channels], 0 to 1.
        offsets: int64 [n + 1], where each begins.
        widths, heights: int64 [n], px.
    """

    values: NDArray[np.float32]
    offsets: NDArray[np.int64]
    widths: NDArray[np.int64]
    heights: NDArray[np.int64]
    _smoothed: dict[float, tuple[NDArray[np.float32], NDArray[np.float32]]] = field(default_factory=dict)

    @classmethod
    def stacked(cls, photos: list[NDArray[np.float32]]) -> PatchPhotos:
        """From photos [h, w, channels], one by one."""
        heights, widths = np.array([photo.shape[:2] for photo in photos], np.int64).T
        offsets = np.concatenate(([0], np.cumsum(heights * widths))).astype(np.int64)
        return cls(np.concatenate([p.reshape(-1, p.shape[2]) for p in photos]), offsets, widths, heights)

    def smoothed(self, blur_px: float) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """All photos blurred, and the coefficients of the cubic B-splines through them; computed once."""
        if blur_px not in self._smoothed:
            smooth, coefficients = np.empty_like(self.values), np.empty_like(self.values)
            for i in range(len(self.widths)):
                rows, photo = slice(self.offsets[i], self.offsets[i + 1]), blurred(self.of(i), blur_px)
                smooth[rows] = photo.reshape(-1, photo.shape[2])
                coefficients[rows] = spline_coefficients(photo).reshape(-1, photo.shape[2])
            self._smoothed[blur_px] = smooth, coefficients
        return self._smoothed[blur_px]

    def of(self, image: int) -> NDArray[np.float32]:
        """One photo [h, w, channels], a view."""
        rows = self.values[self.offsets[image] : self.offsets[image + 1]]
        return rows.reshape(int(self.heights[image]), int(self.widths[image]), -1)


@dataclass(frozen=True, eq=False)
class Positions:
    """Measured places of cameras, in a separate frame.

    Attributes:
        image: int64 [m].
        metres, deviation: [m, 3], and standard deviations along the axes, m.
        stated: whether these are known; otherwise they are one, and the residuals give the scale.
    """

    image: NDArray[np.int64]
    metres: Array
    deviation: Array
    stated: bool

    @classmethod
    def of(cls, image: NDArray[np.int64], metres: Array, accuracy: Array) -> Positions:
        """From accuracies [m, 3], NaN where they are not known: if most are known, only those positions are used."""
        known = np.asarray(np.isfinite(accuracy).all(1))
        if 2 * known.sum() < len(known):
            return cls(image, metres, np.ones_like(metres), stated=False)
        return cls(image[known], metres[known], accuracy[known], stated=True)


@dataclass(frozen=True, eq=False)
class Control:
    """Points whose coordinates were measured, in a frame of its own.

    Attributes:
        tracks: where photos show them, through the evidence's intrinsics.
        metres, deviation: [p, 3], and standard deviations along the axes, m.
    """

    tracks: Tracks
    metres: Array
    deviation: Array

    @classmethod
    def of(cls, tracks: Tracks, metres: Array, accuracy: Array) -> Control:
        """From accuracies [p, 3], NaN where they are not known: the points' marks then give the accuracy."""
        exact = EXACT * rms_spread(metres)
        return cls(tracks, metres, np.where(np.isfinite(accuracy), np.maximum(accuracy, exact), exact))


@dataclass(frozen=True, eq=False)
class Evidence:
    """What the poses are adjusted to.

    Attributes:
        intrinsics: of all images at full size, without distortion but for fisheyes:
            `biresnerf.refinement.adjustment.ideal` makes them.
        tracks: None where there are none.
        patches: None where there are none.
        lenses: how the lenses differ from the intrinsics, and how well that is known; None: not at all.
        positions, control: None where none are measured, or they tell nothing.
        numbers: how the evidence is weighted, and when it is believed.
    """

    intrinsics: Intrinsics
    tracks: Tracks | None = None
    patches: Patches | None = None
    lenses: Lenses | None = None
    positions: Positions | None = None
    control: Control | None = None
    numbers: EvidenceNumbers = EvidenceNumbers()

    @property
    def held_by_measurements(self) -> NDArray[np.int64]:
        """Images whose place in the rig is fixed by measured places: with control points, all that tracks tie."""
        held = [] if self.positions is None else [self.positions.image]
        held += [self.tracks.image] if self.control is not None and self.tracks is not None else []
        return np.unique(np.concatenate([np.zeros(0, np.int64), *held]))

    def __post_init__(self) -> None:
        if bool(self.intrinsics.distortion[~self.intrinsics.fisheye].any()):
            raise ValueError("evidence is of ideal cameras: straighten photos and tracks first")


@dataclass(frozen=True, eq=False)
class PosePrior:
    """Poses known a priori, with the standard deviations of their errors.

    Attributes:
        world_from_cam: [n, 4, 4].
        rotation: rad [n], of each component of the rotation vector. Infinite: not known. Zero: the camera is fixed.
        position: [n], of each coordinate, in the poses' unit.
        bodies: cameras that move as one, and cameras that are fixed as well.
    """

    world_from_cam: Array
    rotation: Array
    position: Array
    bodies: RigidBodies

    @classmethod
    def equal(
        cls, world_from_cam: Array, rotation: float, position: float, bodies: RigidBodies | None = None
    ) -> PosePrior:
        """All cameras known equally well."""
        n = len(world_from_cam)
        free = bodies or RigidBodies.free(n)
        return cls(world_from_cam, np.full(n, rotation), np.full(n, position), free)

    @property
    def fixed(self) -> NDArray[np.bool_]:
        """Cameras [n] that are known exactly, or move as one with such a camera."""
        exact = (self.rotation <= 0) | (self.position <= 0)
        return np.isin(self.bodies.of, self.bodies.of[exact | self.bodies.fixed])
