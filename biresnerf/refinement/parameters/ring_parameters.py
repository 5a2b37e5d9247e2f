"""Cameras before a turning table as parameters of the optimisation: an azimuth for each, one roll and pan for all."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from biresnerf.geometry.turntable import Ring
from biresnerf.refinement.parameters.pose_parameters import PoseParameters


class RingParameters(PoseParameters):
    """Cameras that stay on one ring about the unit frame's z axis, at its elevation.

    A camera's azimuth grows by the mean of the first numbers of the rotations around it, weighed by how near they are
    on its run: steps of one run are alike. Roll and pan grow by the mean over all cameras of the second number of their
    rotations and the first of their translations. All cameras have the same share in such a mean, so Adam moves all
    of them alike and the mean by a whole step.

    Args:
        ring: where the increments start.
        distance: of the cameras, unit lengths.
        run: number of the run [n] that each photo belongs to.
        reach: see `smoothing`.
    """

    def __init__(self, ring: Ring, distance: float, run: Tensor, device: torch.device, reach: float) -> None:
        poses = torch.from_numpy(ring.matrices())
        poses[:, :3, 3] *= distance
        super().__init__(poses, distance, device)
        parts = (ring.azimuth, ring.elevation, ring.pan, ring.roll, ring.quarters)
        self.ring = Ring(*(part.float().to(device) for part in parts))
        self.smoothing = smoothing(self.ring.azimuth, run.to(device), reach)

    def matrices(self) -> Tensor:
        poses = self.now().poses()
        return torch.cat([poses[:, :, :3], poses[:, :, 3:] * self.length], 2)

    def now(self) -> Ring:
        """The ring after the increments, differentiable."""
        ring = self.ring
        return replace(
            ring,
            azimuth=ring.azimuth + self.smoothing @ self.rotation[:, 0],
            roll=ring.roll + self.rotation[:, 1].mean(),
            pan=ring.pan + self.translation[:, 0].mean(),
        )


def smoothing(azimuth: Tensor, run: Tensor, reach: float) -> Tensor:
    """Weights [n, n], rows of sum one, with which what moves one camera moves those of its run near it.

    Args:
        reach: of their standard deviation, in mean steps between photos.
    """
    apart = torch.remainder(azimuth[:, None] - azimuth[None] + torch.pi, 2 * torch.pi) - torch.pi
    deviation = reach * 2 * torch.pi / len(azimuth)
    near = torch.exp(-0.5 * (apart / deviation) ** 2) * (run[:, None] == run[None])
    return near / near.sum(1, keepdim=True)
