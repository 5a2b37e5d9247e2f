"""Fisheyes for the pinhole kernels: a separate view for each observation, directed at what was observed."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from biresnerf.arrays import Array
from biresnerf.geometry.camera.camera import Intrinsics, directions_in_cam, project
from biresnerf.refinement.adjustment.cameras import LENS_ROW, SHOWN_ROW, Cameras
from biresnerf.refinement.adjustment.lens.fisheyes import moved_by_lens, with_corrections

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
        lens: of the fisheyes' views, as the kernels take them: [m, 11], or [m, 28] where lenses are unknown.
        xy: [m, 2], the observations in their views, px.
    """

    of: NDArray[np.int64]
    cam_from_view: Array
    fisheye: NDArray[np.bool_]
    lens: Array
    xy: Array

    @classmethod
    def looking_at(
        cls, xy: Array, image: NDArray[np.int64], intrinsics: Intrinsics, near: Array, cameras: Cameras
    ) -> TangentViews:
        """The views of observations at `xy` [m, 2] of photos, by the cameras' present lenses.

        Args:
            intrinsics: of the evidence.
            near: [n], of each photo the least depth at which something is in front.
        """
        now = with_corrections(intrinsics, cameras.lens_of, cameras.lens)
        fisheye = intrinsics.fisheye.numpy()[image]
        of, at = image[fisheye], xy[fisheye]
        unknown = bool(len(cameras.kinds))
        turn = np.tile(np.eye(3), (len(image), 1, 1))
        lens = np.zeros((len(image), SHOWN_ROW if unknown else LENS_ROW))
        turn[fisheye] = _away_and_around(
            directions_in_cam(now, torch.from_numpy(of), torch.from_numpy(at)).numpy()
        )
        by_slope = _photo_by_slope(turn[fisheye], of, now)
        scale = np.linalg.norm(by_slope, axis=1)
        lens[fisheye, :2] = scale
        lens[:, 4] = near[image]
        if unknown:
            view_from_photo = scale[:, :, None] * np.linalg.inv(by_slope)
            moved = view_from_photo @ moved_by_lens(now, intrinsics, of, at)  # [m, 2, 8]
            lens[fisheye, LENS_ROW] = 1.0
            lens[fisheye, LENS_ROW + 1 :] = moved.transpose(0, 2, 1).reshape(len(of), -1)
        return cls(image, turn, fisheye, lens, np.where(fisheye[:, None], 0.0, xy))

    def seen(self, cameras: Cameras, lens: Array) -> tuple[Array, Array, Array, NDArray[np.int64]]:
        """The views' rotations [m, 3, 3], centres [m, 3], lenses as the kernels take them and numbers [m].

        Args:
            lens: of the photos [n, 11].
        """
        lenses = self.lens.copy()
        lenses[~self.fisheye, :LENS_ROW] = lens[self.of[~self.fisheye]]
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


def _photo_by_slope(cam_from_view: Array, image: NDArray[np.int64], intrinsics: Intrinsics) -> Array:
    """Derivatives [m, 2, 2] of where photos (px) show what is straight ahead in views, by the views' two slopes."""

    def shown(away: float, around: float) -> Array:
        rays = cam_from_view @ np.array([away, around, 1.0])
        return project(intrinsics, torch.from_numpy(image), torch.from_numpy(rays)).numpy()

    steps = shown(_STEP, 0) - shown(-_STEP, 0), shown(0, _STEP) - shown(0, -_STEP)
    return np.stack(steps, 2) / (2 * _STEP)
