"""Increments of cameras before a turning table: an azimuth for each, and one roll and pan for all."""

from __future__ import annotations

import torch
from torch import Tensor

from biresnerf.geometry.turntable import Ring
from biresnerf.refine.parameters.parametrisations import Parametrisation

SMOOTH_STEPS = 3.0  # mean steps between photos: the reach, as a standard deviation, of what moves one azimuth


class TurntableRig(Parametrisation):
    """Cameras that stay on one ring about the unit frame's z axis, at its elevation.

    A camera's azimuth grows by the mean of the first numbers of the rotations around it, weighed by how near they are
    on its run: steps of one run are alike. Roll and pan grow by the mean over all cameras of the second number of their
    rotations and the first of their translations. All cameras have the same share in such a mean, so Adam moves all
    of them alike and the mean by a whole step.

    Args:
        ring: where the increments start.
        distance: of the cameras, unit lengths.
        run: number of the run [n] that each photo belongs to.
    """

    moves_bodies = False

    def __init__(self, ring: Ring, distance: float, run: Tensor) -> None:
        super().__init__(distance)
        self.ring = ring
        self.smoothing = smoothing(ring.azimuth, run)

    def moved(self, start: Tensor, rotation: Tensor, translation: Tensor, body: Tensor | None) -> Tensor:
        poses = self.now(rotation, translation).poses()
        return torch.cat([poses[:, :, :3], poses[:, :, 3:] * self.length], 2)

    def now(self, rotation: Tensor, translation: Tensor) -> Ring:
        """The ring after increments [n, 3]."""
        start = self.ring
        return Ring(
            start.azimuth.to(rotation) + self.smoothing.to(rotation) @ rotation[:, 0],
            start.elevation.to(rotation),
            start.pan.to(rotation) + translation[:, 0].mean(),
            start.roll.to(rotation) + rotation[:, 1].mean(),
            start.quarters.to(rotation),
        )

    def start_shift(self, start: Tensor, now: Tensor, shift: Tensor) -> Tensor:
        raise NotImplementedError("cameras of a ring do not dolly")


def smoothing(azimuth: Tensor, run: Tensor) -> Tensor:
    """Weights [n, n], rows of sum one, with which what moves one camera moves those of its run near it."""
    apart = torch.remainder(azimuth[:, None] - azimuth[None] + torch.pi, 2 * torch.pi) - torch.pi
    reach = SMOOTH_STEPS * 2 * torch.pi / len(azimuth)
    near = torch.exp(-0.5 * (apart / reach) ** 2) * (run[:, None] == run[None])
    return near / near.sum(1, keepdim=True)
