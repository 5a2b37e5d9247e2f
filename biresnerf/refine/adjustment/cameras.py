"""The cameras while they are being adjusted."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from biresnerf.geometry.camera.camera import Intrinsics
from biresnerf.geometry.lie import so3_exp, so3_log
from biresnerf.geometry.similarity import nearest_rotation

Array = NDArray[np.float64]

# Of the cameras' mean distance from their middle. A wrong match may put its point right before a camera, where the
# residual changes without bound.
NEAR = 0.01


@dataclass(frozen=True, eq=False)
class Cameras:
    """Rotations (world from cam) [n, 3, 3] and centres [n, 3]."""

    rotation: Array
    centre: Array

    @classmethod
    def of(cls, world_from_cam: Array) -> Cameras:
        """From poses [n, 4, 4]."""
        poses = np.asarray(world_from_cam, dtype=np.float64)
        return cls(np.ascontiguousarray(poses[:, :3, :3]), np.ascontiguousarray(poses[:, :3, 3]))

    def __len__(self) -> int:
        return len(self.centre)

    def world_from_cam(self) -> Array:
        """Poses [n, 4, 4], their rotations exact to rounding."""
        poses = np.zeros((len(self), 4, 4))
        poses[:, :3, :3], poses[:, :3, 3], poses[:, 3, 3] = nearest_rotation(self.rotation), self.centre, 1.0
        return poses

    def moved(self, motion: Array) -> Cameras:
        """After increments [n, 6]: a rotation vector and a shift, both in the world's axes."""
        turn = so3_exp(torch.from_numpy(np.ascontiguousarray(motion[:, :3]))).numpy()
        return Cameras(turn @ self.rotation, self.centre + motion[:, 3:])

    def apart(self, other: Cameras) -> Array:
        """The increments [n, 6] that lead from `other` to these cameras."""
        turn = np.ascontiguousarray(self.rotation @ other.rotation.transpose(0, 2, 1))
        return np.concatenate([so3_log(torch.from_numpy(turn)).numpy(), self.centre - other.centre], axis=1)


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
