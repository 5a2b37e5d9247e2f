"""Finds photos that do not determine their pose: they fit as well after their camera was turned about the scene.

An object that looks alike from several sides, such as a vase with a hidden handle, lets a camera slide far while its
error stays small, so the error alone cannot show it. Each camera is turned about the scene's centre in the direction
to which its photo is least sensitive, and the error is measured again.
"""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from biresnerf.field.radiance_field import PositionGradient
from biresnerf.geometry.lie import so3_exp
from biresnerf.refine.optimise.joint_optimiser import JointOptimiser

Array = NDArray[np.float64]

SIDE = 16  # 16 x 16 pixels spread over the photo are compared
AT_ONCE = 32  # cameras
# Degrees by which a camera is turned. Smaller angles say nothing: at 4, many cameras of a plain vase that were right
# to half a degree fitted as well.
ANGLES_DEG = (8.0, 16.0, 32.0)
# An error ratio below this hardly differs from 1. Five of the vase's 40 cameras are below it, the worst one among
# them; on a textured dome the smallest ratio is 2.4.
AS_WELL = 1.25
# Root mean square of a photo's residual. Above this, the residual may be the very texture that would distinguish
# poses: after 250 steps fox's (0.93 and more), after 120 steps that of a small textured set.
EXPLAINED = 0.03
STEP = 0.01  # of finite differences: radians, and shares of the camera's distance
SLACK = 1e-6  # keeps the system solvable for directions to which no pixel is sensitive


@torch.no_grad()
def unsure_deg(optimiser: JointOptimiser) -> Array:
    """The largest of `ANGLES_DEG` by which each camera [n] can be turned and still fit its photo; 0 where none.

    It still fits if the error is about as small as now, or as the median camera's. Also 0 where the field does not
    explain the photo well enough to decide, and for fixed cameras, which are assumed right.
    """
    probes = [
        _Probe(optimiser, part)
        for part in torch.arange(len(optimiser.poses), device=optimiser.device).split(AT_ONCE)
    ]
    own = torch.cat([probe.error(torch.zeros_like(probe.weakest[0])) for probe in probes])
    enough = torch.where(own <= EXPLAINED**2, AS_WELL * torch.maximum(own, own.median()), -torch.inf)
    result = torch.zeros_like(own)
    for angle in ANGLES_DEG:
        least = torch.cat([probe.least_error(float(np.radians(angle))) for probe in probes])
        result = torch.where(least <= enough, angle, result)
    result[torch.from_numpy(optimiser.bodies.fixed).to(result.device)] = 0.0
    return result.double().cpu().numpy()


class _Probe:
    """Some cameras, and the errors of their photos at poses near theirs.

    A motion [k, 6] is a rotation about the scene's centre by the camera's axes (radians), then a shift along them
    (in the camera's distance).

    Attributes:
        weakest: motions that turn by one radian in the direction to which photos are least sensitive: with the shift
            that compensates most of it, and without.
    """

    def __init__(self, optimiser: JointOptimiser, cameras: Tensor) -> None:
        self.optimiser = optimiser
        self.matrices = optimiser.poses.matrices()[cameras]
        self.distance = self.matrices[:, :, 3].norm(dim=1, keepdim=True)
        self.image = cameras.repeat_interleave(SIDE**2)
        along = (torch.arange(SIDE, device=cameras.device) + 0.5) / SIDE
        grid = torch.stack(torch.meshgrid(along, along, indexing="xy"), -1).reshape(-1, 2)
        self.xy = (grid.repeat(len(cameras), 1) * optimiser.sampler.sizes[0][self.image]).floor() + 0.5
        self.target = optimiser.sampler.colours(self.image, self.xy, 0.0)
        counting = optimiser.sampler.counting(self.image, self.xy)
        self.counts = torch.ones_like(self.xy[:, 0]) if counting is None else counting
        self.shares = optimiser.camera_errors.shares[cameras]
        self.weakest = self._weakest()

    def _moved(self, motion: Tensor) -> Tensor:
        turn = so3_exp((self.matrices[:, :, :3] @ motion[:, :3, None])[:, :, 0])
        matrices = turn @ self.matrices
        shift = (matrices[:, :, :3] @ motion[:, 3:, None])[:, :, 0] * self.distance
        return torch.cat([matrices[:, :, :3], (matrices[:, :, 3] + shift)[:, :, None]], 2)

    def _colours(self, motion: Tensor) -> Tensor:
        optimiser = self.optimiser
        matrices = self._moved(motion).repeat_interleave(SIDE**2, 0)
        origin, direction = optimiser.cast(matrices, self.image, self.xy)
        rendering = optimiser.render(
            origin, direction, 0, optimiser.schedule.fine_interval, PositionGradient(), jitter=False
        )
        colour = optimiser.exposure.refitted(rendering, self.target, self.counts, len(motion))
        return optimiser.exposure.forgiven(colour, self.target)

    def _per_camera(self, values: Tensor) -> Tensor:
        """Values [rays, ...] of pixels that count, [k, rays of one, ...]."""
        counts = self.counts.reshape(-1, *[1] * (values.dim() - 1))
        return (values * counts).reshape(len(self.matrices), -1, *values.shape[1:])

    def error(self, motion: Tensor) -> Tensor:
        """Mean squared error [k] per pixel that shows the scene, with each camera moved."""
        squared = self._per_camera(((self._colours(motion) - self.target) ** 2).mean(1))
        return (
            squared.sum(1) / self._per_camera(torch.ones_like(self.counts)).sum(1).clamp(min=1) / self.shares
        )

    def least_error(self, angle: float) -> Tensor:
        """The smallest error [k] of the cameras turned by `angle` (radians), either way."""
        ways = [self.error(sign * angle * motion) for motion in self.weakest for sign in (-1, 1)]
        return torch.stack(ways).amin(0)

    def _weakest(self) -> tuple[Tensor, Tensor]:
        columns = []
        for axis in torch.eye(6, device=self.matrices.device) * STEP:
            motion = axis.expand(len(self.matrices), 6)
            columns.append((self._colours(motion) - self._colours(-motion)) / (2 * STEP))
        jacobian = self._per_camera(torch.stack(columns, -1)).flatten(1, 2)
        normal = jacobian.transpose(1, 2) @ jacobian / jacobian.shape[1]
        turn, both, shift = normal[:, :3, :3], normal[:, :3, 3:], normal[:, 3:, 3:]
        slack = SLACK * torch.eye(3, device=normal.device)
        made_up = torch.linalg.solve(shift + slack, both.transpose(1, 2))
        weakest = torch.linalg.eigh(turn - both @ made_up)[1][:, :, :1]
        following = -(made_up @ weakest)
        alone = torch.zeros_like(following)
        return torch.cat([weakest, following], 1)[:, :, 0], torch.cat([weakest, alone], 1)[:, :, 0]
