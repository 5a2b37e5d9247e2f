"""The cameras while they are being adjusted."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
import torch
from numpy.typing import NDArray

from biresnerf.arrays import Array
from biresnerf.geometry.camera.camera import Intrinsics
from biresnerf.geometry.rigid import rotation_of, rotation_vectors
from biresnerf.geometry.similarity import nearest_rotation
from biresnerf.refinement.adjustment.lens.lenses import (
    ASPECT,
    CENTRE,
    DISTORTION,
    FOCAL,
    LENS,
    Lenses,
    slopes_seen,
)

# Of the cameras' mean distance from their middle. A wrong match may put its point right before a camera, where the
# residual changes without bound.
NEAR = 0.01
POSE = 6  # unknowns of a camera
LENS_ROW = 11  # numbers that the kernels take of a lens
# And with 1 for a fisheye's view, and where it shows its observation by each of the lens's unknowns.
SHOWN_ROW = LENS_ROW + 1 + 2 * LENS


@dataclass(frozen=True, eq=False)
class Cameras:
    """Rotations (world from cam) [n, 3, 3], centres [n, 3], and how their lenses differ from those of the evidence.

    Attributes:
        lens: [g, 8], see `biresnerf.refinement.adjustment.lens.lenses`. Without rows all are as in the evidence.
        lens_of: int64 [n], the row of each camera's lens.
        kinds: int64, the lens parameters that are unknown for at least one lens.
    """

    rotation: Array
    centre: Array
    lens: Array = field(default_factory=lambda: np.zeros((0, LENS)))
    lens_of: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, np.int64))
    kinds: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, np.int64))

    @classmethod
    def of(cls, world_from_cam: Array, lenses: Lenses | None = None) -> Cameras:
        """From poses [n, 4, 4]."""
        poses = np.asarray(world_from_cam, dtype=np.float64)
        pose = np.ascontiguousarray(poses[:, :3, :3]), np.ascontiguousarray(poses[:, :3, 3])
        if lenses is None:
            return cls(*pose)
        return cls(*pose, lenses.correction, lenses.of_image, np.flatnonzero(lenses.free.any(0)))

    def __len__(self) -> int:
        return len(self.centre)

    @property
    def unknowns(self) -> int:
        """The length of an increment: 6n + 8g."""
        return POSE * len(self) + LENS * len(self.lens)

    def world_from_cam(self) -> Array:
        """Poses [n, 4, 4], their rotations exact to rounding."""
        poses = np.zeros((len(self), 4, 4))
        poses[:, :3, :3], poses[:, :3, 3], poses[:, 3, 3] = nearest_rotation(self.rotation), self.centre, 1.0
        return poses

    def moved(self, motion: Array) -> Cameras:
        """The cameras after an increment [6n + 8g]: for each a rotation vector and a shift in the world's axes."""
        poses, lenses = self.split(motion)
        turn = rotation_of(poses[:, :3])
        return replace(
            self, rotation=turn @ self.rotation, centre=self.centre + poses[:, 3:], lens=self.lens + lenses
        )

    def apart(self, other: Cameras) -> Array:
        """The increment [6n + 8g] that leads from `other` to these cameras."""
        turned = rotation_vectors(self.rotation @ other.rotation.transpose(0, 2, 1))
        poses = np.concatenate([turned, self.centre - other.centre], axis=1)
        return np.concatenate([poses.reshape(-1), (self.lens - other.lens).reshape(-1)])

    def same_lenses(self, other: Cameras) -> bool:
        """Whether the lenses and their unknown parameters are the same."""
        return np.array_equal(self.lens, other.lens) and np.array_equal(self.kinds, other.kinds)

    def split(self, unknowns: Array) -> tuple[Array, Array]:
        """The parts [n, 6] and [g, 8] of a vector of all unknowns."""
        poses, lenses = np.split(unknowns, [POSE * len(self)])
        return poses.reshape(-1, POSE), lenses.reshape(-1, LENS)

    def rows(self, image: NDArray[np.int64]) -> NDArray[np.int64]:
        """Where each image's pose, and the `kinds` of its lens, are among the unknowns, [m, 6 + kinds]."""
        poses = POSE * image[:, None] + np.arange(POSE)
        if not len(self.kinds):
            return poses
        lenses = POSE * len(self) + LENS * self.lens_of[image][:, None] + self.kinds
        return np.concatenate([poses, lenses], axis=1)

    def parts(self, image: NDArray[np.int64]) -> NDArray[np.int64]:
        """Each image's camera among cameras and lenses, and its lens if anything of lenses is unknown, [m, 1 or 2]."""
        parts = [image, len(self) + self.lens_of[image]] if len(self.kinds) else [image]
        return np.stack(parts, 1)

    @property
    def offsets(self) -> NDArray[np.int64]:
        """Where the unknowns of `rows` are within their part [6 + kinds]."""
        return np.concatenate([np.arange(POSE), self.kinds])

    def lens_rows(self, given: Array) -> Array:
        """Rows of `lens_rows` [n, 5] as the kernels take lenses like these [n, 11]."""
        rows = np.concatenate([given, np.zeros((len(given), 4)), given[:, :2]], axis=1)
        if len(self.lens):
            now = self.lens[self.lens_of]
            rows[:, :2] *= np.exp(now[:, [FOCAL]] + now[:, [ASPECT]] * [0.0, 1.0])
            rows[:, 2:4] += given[:, :2] * now[:, CENTRE]
            rows[:, 5:9] = now[:, DISTORTION]
        return rows

    def rays_of(self, image: NDArray[np.int64], rays: Array) -> Array:
        """Rays [m, ..., 3] with z = 1 of pixels through these lenses, from those through the evidence's lenses."""
        if not len(self.lens):
            return rays
        now = self.lens[self.lens_of[image]].reshape(-1, *(1,) * (rays.ndim - 2), LENS)
        return np.concatenate([slopes_seen(now, rays[..., :2]), rays[..., 2:]], axis=-1)


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
