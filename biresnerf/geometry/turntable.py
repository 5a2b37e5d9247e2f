"""Cameras that stand still before a turning table, in the frame of what turns: a ring about the z axis."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from biresnerf.geometry.lie import so3_exp
from biresnerf.geometry.rigid import motion_of


@dataclass(frozen=True, eq=False)
class Ring:
    """Cameras at distance one from the origin, which is where their optical axes pass the z axis nearest.

    Angles are in radians.

    Attributes:
        azimuth: of each camera [n].
        elevation: of all cameras above the origin's plane [].
        pan: angle by which the z axis is seen to the right of the optical axis [].
        roll: of all cameras about their optical axes [].
        quarters: quarter turns [n], counter-clockwise, that set each photo upright.
    """

    azimuth: Tensor
    elevation: Tensor
    pan: Tensor
    roll: Tensor
    quarters: Tensor

    @classmethod
    def level(cls, azimuth: Tensor) -> Ring:
        """Upright cameras that look at the origin from its own height."""
        none = azimuth.new_zeros(())
        return cls(azimuth, none, none, none, torch.zeros_like(azimuth))

    def poses(self) -> Tensor:
        """Poses world_from_cam [n, 3, 4], differentiable."""
        zero = torch.zeros_like(self.azimuth)
        across, high = torch.cos(self.elevation), torch.sin(self.elevation).expand_as(zero)
        cosine, sine = torch.cos(self.azimuth), torch.sin(self.azimuth)
        outward = torch.stack([across * cosine, across * sine, high], 1)
        right = torch.stack([-sine, cosine, zero], 1)
        facing = torch.stack([right, torch.linalg.cross(-outward, right), -outward], 2)
        _, y, z = torch.eye(3, dtype=zero.dtype, device=zero.device)
        turn = self.roll - self.quarters.to(zero) * (torch.pi / 2)
        panned, turned = so3_exp(-self.pan * y), so3_exp(turn[:, None] * z)
        return torch.cat([facing @ panned @ turned, outward[:, :, None]], 2)

    def detached(self) -> Ring:
        """The same ring on the CPU, without gradient."""
        parts = (self.azimuth, self.elevation, self.pan, self.roll, self.quarters)
        return Ring(*(part.detach().cpu() for part in parts))

    def matrices(self) -> NDArray[np.float64]:
        """Poses world_from_cam [n, 4, 4], in double precision whatever that of the angles is."""
        there = self.detached()
        parts = (there.azimuth, there.elevation, there.pan, there.roll, there.quarters)
        top = Ring(*(part.double() for part in parts)).poses().numpy()
        return motion_of(top[:, :, :3], top[:, :, 3])
