"""Fisheyes for the kernels of pinholes: a view of its own for each observation, straight at what was observed."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from biresnerf.geometry.camera.camera import Intrinsics, project
from biresnerf.refinement.adjustment.cameras import LENS_ROW, Cameras

Array = NDArray[np.float64]

_STEP = 1e-4  # rad, of the differences that say how large a fisheye shows things


@dataclass(frozen=True, eq=False)
class TangentViews:
    """The views that observations are seen in: their photo's pinhole, or a fisheye's tangent plane.

    On the plane that touches the sphere of directions at the observation, one axis leads away from the lens's axis and
    the other around it, each with the scale of the fisheye there: small errors are as long as in its photo.

    Attributes:
        of: int64 [m], the photo of each observation.
        cam_from_view: [m, 3, 3].
        fisheye: bool [m].
        lens: [m, 11], of the fisheyes' views, as the kernels take them.
        xy: [m, 2], the observations in their views, px.
    """

    of: NDArray[np.int64]
    cam_from_view: Array
    fisheye: NDArray[np.bool_]
    lens: Array
    xy: Array

    @classmethod
    def looking_at(
        cls, rays: Array, xy: Array, image: NDArray[np.int64], intrinsics: Intrinsics, near: Array
    ) -> TangentViews:
        """Of observations at `xy` [m, 2] of photos, whose unit rays in the camera are [m, 3].

        Args:
            near: [n], of each photo the least depth at which something is in front.
        """
        fisheye = intrinsics.fisheye.numpy()[image]
        turn, lens = np.tile(np.eye(3), (len(image), 1, 1)), np.zeros((len(image), LENS_ROW))
        turn[fisheye] = _away_and_around(rays[fisheye])
        lens[fisheye, :2] = _scales(turn[fisheye], image[fisheye], intrinsics)
        lens[:, 4] = near[image]
        return cls(image, turn, fisheye, lens, np.where(fisheye[:, None], 0.0, xy))

    def seen(self, cameras: Cameras, lens: Array) -> tuple[Array, Array, Array, NDArray[np.int64]]:
        """The views' rotations [m, 3, 3], centres [m, 3], lenses [m, 11] and numbers [m].

        Args:
            lens: of the photos [n, 11].
        """
        lenses = np.where(self.fisheye[:, None], self.lens, lens[self.of])
        rotation = cameras.rotation[self.of] @ self.cam_from_view
        return rotation, cameras.centre[self.of], lenses, np.arange(len(self.of))


def _away_and_around(forward: Array) -> Array:
    """Axes [m, 3, 3], as columns, of views along unit rays [m, 3]: away from the lens's axis, around it, forward."""
    around = np.cross([0.0, 0.0, 1.0], forward)
    length = np.linalg.norm(around, axis=1, keepdims=True)
    around = np.where(length > _STEP, around / np.maximum(length, _STEP), [0.0, 1.0, 0.0])
    away = np.cross(around, forward)
    away /= np.linalg.norm(away, axis=1, keepdims=True)
    return np.stack([away, np.cross(forward, away), forward], 2)


def _scales(cam_from_view: Array, image: NDArray[np.int64], intrinsics: Intrinsics) -> Array:
    """Pixels per radian [m, 2] along both axes of views, straight ahead."""

    def shown(away: float, around: float) -> Array:
        rays = cam_from_view @ np.array([away, around, 1.0])
        return project(intrinsics, torch.from_numpy(image), torch.from_numpy(rays)).numpy()

    steps = shown(_STEP, 0) - shown(-_STEP, 0), shown(0, _STEP) - shown(0, -_STEP)
    return np.stack([np.linalg.norm(step, axis=1) for step in steps], 1) / (2 * _STEP)
