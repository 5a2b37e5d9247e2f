"""The cameras while they are being adjusted."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import torch
from numpy.typing import NDArray

from biresnerf.geometry.camera.camera import Intrinsics
from biresnerf.geometry.lie import so3_exp, so3_log
from biresnerf.geometry.similarity import nearest_rotation
from biresnerf.refinement.adjustment.lens.lenses import LENS, Lenses, narrowing

Array = NDArray[np.float64]

# Of the cameras' mean distance from their middle. A wrong match may put its point right before a camera, where the
# residual changes without bound.
NEAR = 0.01
POSE = 6  # unknowns of a camera


@dataclass(frozen=True, eq=False)
class Cameras:
    """Rotations (world from cam) [n, 3, 3], centres [n, 3], and how their lenses differ from those of the evidence.

    Attributes:
        lens: [g, 3], of each lens the logarithm of its focal length over that of the evidence, and two radial
            coefficients: a point at slopes u = (x / z, y / z) appears where the evidence's pinhole would show
            f (1 + k1 |u|^2 + k2 |u|^4) u. Without rows all are as in the evidence.
        lens_of: int64 [n], the row of each camera's lens.
    """

    rotation: Array
    centre: Array
    lens: Array = field(default_factory=lambda: np.zeros((0, LENS)))
    lens_of: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, np.int64))

    @classmethod
    def of(cls, world_from_cam: Array, lenses: Lenses | None = None) -> Cameras:
        """From poses [n, 4, 4]."""
        poses = np.asarray(world_from_cam, dtype=np.float64)
        pose = np.ascontiguousarray(poses[:, :3, :3]), np.ascontiguousarray(poses[:, :3, 3])
        return cls(*pose) if lenses is None else cls(*pose, lenses.correction, lenses.of_image)

    def __len__(self) -> int:
        return len(self.centre)

    @property
    def unknowns(self) -> int:
        """How long an increment is: 6n + 3g."""
        return POSE * len(self) + LENS * len(self.lens)

    def world_from_cam(self) -> Array:
        """Poses [n, 4, 4], their rotations exact to rounding."""
        poses = np.zeros((len(self), 4, 4))
        poses[:, :3, :3], poses[:, :3, 3], poses[:, 3, 3] = nearest_rotation(self.rotation), self.centre, 1.0
        return poses

    def moved(self, motion: Array) -> Cameras:
        """After an increment [6n + 3g]: of each camera a rotation vector and a shift, both in the world's axes."""
        poses, lenses = self.split(motion)
        turn = so3_exp(torch.from_numpy(np.ascontiguousarray(poses[:, :3]))).numpy()
        return Cameras(turn @ self.rotation, self.centre + poses[:, 3:], self.lens + lenses, self.lens_of)

    def apart(self, other: Cameras) -> Array:
        """The increment [6n + 3g] that leads from `other` to these cameras."""
        turn = np.ascontiguousarray(self.rotation @ other.rotation.transpose(0, 2, 1))
        turned = so3_log(torch.from_numpy(turn)).numpy()
        poses = np.concatenate([turned, self.centre - other.centre], axis=1)
        return np.concatenate([poses.reshape(-1), (self.lens - other.lens).reshape(-1)])

    def split(self, unknowns: Array) -> tuple[Array, Array]:
        """The parts [n, 6] and [g, 3] of a vector of all unknowns."""
        poses, lenses = np.split(unknowns, [POSE * len(self)])
        return poses.reshape(-1, POSE), lenses.reshape(-1, LENS)

    def rows(self, image: NDArray[np.int64]) -> NDArray[np.int64]:
        """Where each image's pose, and its lens where lenses are unknown, are among the unknowns, [m, 6 or 9]."""
        poses = POSE * image[:, None] + np.arange(POSE)
        if not len(self.lens):
            return poses
        lenses = POSE * len(self) + LENS * self.lens_of[image][:, None] + np.arange(LENS)
        return np.concatenate([poses, lenses], axis=1)

    def lens_rows(self, given: Array) -> Array:
        """Rows of `lens_rows` as these lenses have them, with the radial coefficients behind [n, 7]."""
        rows = np.concatenate([given, np.zeros((len(given), 2))], axis=1)
        if len(self.lens):
            now = self.lens[self.lens_of]
            rows[:, :2] *= np.exp(now[:, :1])
            rows[:, 5:] = now[:, 1:]
        return rows

    def rays_of(self, image: NDArray[np.int64], rays: Array) -> Array:
        """Rays [m, ..., 3] with z = 1 of pixels, as these lenses have them, from those of the evidence's lenses."""
        if not len(self.lens):
            return rays
        now = self.lens[self.lens_of[image]].reshape(-1, *(1,) * (rays.ndim - 2), LENS)
        return np.concatenate([rays[..., :2] * narrowing(now, rays[..., :2]), rays[..., 2:]], axis=-1)


def lens_rows(intrinsics: Intrinsics, cameras: Cameras) -> Array:
    """Pinhole intrinsics as rows [n, 5]: fx, fy, cx, cy, and the least depth at which something is in front."""
    near = NEAR * float(np.linalg.norm(cameras.centre - cameras.centre.mean(0), axis=1).mean())
    columns = [
        intrinsics.fx,
        intrinsics.fy,
        intrinsics.cx,
        intrinsics.cy,
        torch.full_like(intrinsics.fx, near),
    ]
    return np.ascontiguousarray(torch.stack(columns, 1).double().cpu().numpy())
