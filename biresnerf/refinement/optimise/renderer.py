"""What the field shows of the scene: rays of cameras, cast and rendered over its background."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from biresnerf.field.backends import Directions, camera_kernels
from biresnerf.field.radiance_field import Marching, PositionGradient, RadianceField, Rays, Rendering
from biresnerf.geometry.camera.camera import Intrinsics, directions_with_gradient
from biresnerf.refinement.kernels.cast_rays import CastRays
from biresnerf.refinement.parameters.joint_parameters import JointParameters


@dataclass(frozen=True, eq=False)
class Renderer:
    """A field and its cameras at one moment of an optimisation; it moves neither.

    Attributes:
        marching: at stage 2's interval.
        background: colour [3] behind the scene.
        directions: the device's, see `directions_for`.
        draws: random numbers for where sampling starts.
    """

    field: RadianceField
    joint: JointParameters
    marching: Marching
    background: Tensor
    directions: Directions
    draws: torch.Generator

    @property
    def device(self) -> torch.device:
        return self.background.device

    def cast(
        self, matrix: Tensor, image: Tensor, xy: Tensor, intrinsics: Intrinsics | None = None
    ) -> tuple[Tensor, Tensor]:
        """Origin and direction [rays, 3] in the unit frame of pixels `xy` [rays, 2] seen by cameras of images.

        `matrix` [rays, 3, 4] is each ray's unit_from_cam; `intrinsics` are the run's images' where not given.
        """
        lenses = intrinsics or self.joint.lenses.intrinsics
        return turned(matrix, viewing_directions(self.directions, lenses, image, xy))

    def render(
        self,
        origin: Tensor,
        direction: Tensor,
        *,
        jitter: bool = False,
        coarser: float = 1.0,
    ) -> Rendering:
        """Render rays, marched at `coarser` times the interval; `jitter` randomises where sampling starts."""
        rays = self.over_background(origin, direction, 0, jitter=jitter)
        return self.field.render(
            rays, replace(self.marching, step=coarser * self.marching.step), PositionGradient()
        )

    def over_background(self, origin: Tensor, direction: Tensor, trained: int, *, jitter: bool) -> Rays:
        """Rays before the scene's background, the first `trained` of which teach the field."""
        count = len(origin)
        shape = (count,) if self.field.stratified is None else (count, self.field.stratified)
        start = (
            torch.rand(shape, generator=self.draws, device=self.device)
            if jitter
            else torch.full(shape, 0.5, device=self.device)
        )
        background = self.background.expand(count, 3).contiguous()
        return Rays(origin, direction, background, start, trained)


def viewing_directions(directions: Directions, lenses: Intrinsics, image: Tensor, xy: Tensor) -> Tensor:
    """Viewing directions float32 [rays, 3] of pixels `xy` [rays, 2] in their cameras; with gradient where lenses move.

    `directions` is the device's, see `directions_for`.
    """
    with torch.no_grad():
        in_cam = directions(lenses, image, xy).float()
    return directions_with_gradient(lenses, image, xy, in_cam) if lenses.fx.requires_grad else in_cam


def cast_rays(matrices: Tensor, camera: Tensor, in_cam: Tensor) -> tuple[Tensor, Tensor]:
    """Origin and direction [rays, 3] of rays with directions `in_cam` [rays, 3] in cameras `camera` [rays].

    Differentiable by `matrices` [n, 3, 4], which are unit_from_cam, and by `in_cam`.
    """
    if in_cam.requires_grad:
        return turned(matrices[camera], in_cam)
    if matrices.device.type == "cpu":
        origin, direction = CastRays.apply(matrices, camera, in_cam)
        return origin, direction
    if kernels := camera_kernels(matrices.device):
        return kernels.rays_of_cameras(matrices, camera, in_cam)
    return turned(matrices[camera], in_cam)


def turned(matrix: Tensor, in_cam: Tensor) -> tuple[Tensor, Tensor]:
    """Origin and direction [rays, 3] of rays with a unit_from_cam [rays, 3, 4] each."""
    direction = (matrix[:, :, :3] @ in_cam[:, :, None])[:, :, 0]
    return matrix[:, :, 3].contiguous(), direction.contiguous()
