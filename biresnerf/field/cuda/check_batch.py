"""A random field, rays and occupancy grid on which backends are compared; the same on every device.

Also the definition for GPUs, whose tensor cores truncate factors to TF32 (10 bits of mantissa). They do not round: with
truncated factors, Triton's interpreter gave the same differences from the definition as an H200, to each digit. Without
truncation a gradient differs by a fifth where a unit is nearly silent.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

import torch
from torch import Tensor

from biresnerf.field.grid_field import GridField
from biresnerf.field.radiance_field import FieldShape, Marching, Merging, PositionGradient, Rays, Rendering
from biresnerf.field.reference.field import ReferenceField
from biresnerf.geometry.lie import moved_poses

Field = TypeVar("Field", bound=GridField)
MakeField = Callable[[FieldShape, int, torch.device], GridField]
Moved = Callable[[Tensor, Tensor, Tensor, Tensor, Tensor], Tensor]
Cast = Callable[[Tensor, Tensor, Tensor], tuple[Tensor, Tensor]]


def random_field(
    make: Callable[[FieldShape, int, torch.device], Field],
    shape: FieldShape,
    device: torch.device,
    *,
    reconstructing: bool,
) -> Field:
    """A field whose features are large enough to matter, in stage 1 or 2."""
    field = make(shape, 3, device)
    draws = torch.Generator().manual_seed(5)
    with torch.no_grad():
        for table in (field.pose_table, field.reconstruction_table, field.reconstruction_columns):
            table.copy_(torch.rand(table.shape, generator=draws) - 0.5)
    if reconstructing:
        field.start_reconstruction()
    return field


def defined_poses(
    rotation: Tensor, translation: Tensor, body: Tensor, length: Tensor, start: Tensor
) -> Tensor:
    """What `cameras.poses_and_rays.moved_poses` computes."""
    return moved_poses(rotation[body], translation[body] * length, start)


def defined_rays(matrices: Tensor, camera: Tensor, in_cam: Tensor) -> tuple[Tensor, Tensor]:
    """What `cameras.poses_and_rays.rays_of_cameras` computes."""
    return matrices[camera][:, :, 3], (matrices[camera][:, :, :3] @ in_cam[:, :, None])[:, :, 0]


def moved_and_cast(moved: Moved, cast: Cast, angle: float, device: torch.device) -> dict[str, Tensor]:
    """Poses of cameras that have turned by `angle` (rad), some of them together, their rays, and gradients."""
    draws = torch.Generator().manual_seed(11)

    def random(*shape: int) -> Tensor:
        return torch.randn(shape, generator=draws).to(device)

    turns = (angle * torch.nn.functional.normalize(random(4, 3))).requires_grad_()
    shifts, start = random(4, 3).requires_grad_(), random(7, 3, 4)
    body = torch.tensor([0, 0, 1, 2, 2, 2, 3], device=device)
    camera = torch.arange(100, device=device) % 6  # the last one has no ray
    poses = moved(turns, shifts, body, torch.full((1,), 0.7, device=device), start)
    rays = cast(poses, camera, random(100, 3))
    torch.autograd.backward(rays, [random(100, 3), random(100, 3)])
    assert turns.grad is not None
    assert shifts.grad is not None
    return {
        "poses": poses.detach(),
        "origins": rays[0].detach(),
        "directions": rays[1].detach(),
        "gradient by rotations": turns.grad,
        "gradient by translations": shifts.grad,
    }


def random_rays(count: int, trained: int, device: torch.device, *, unbounded: bool, seed: int = 7) -> Rays:
    """Rays through the middle of the scene, from within or without its box; the first `trained` teach the field."""
    draws = torch.Generator().manual_seed(seed)
    direction = torch.nn.functional.normalize(torch.randn(count, 3, generator=draws), dim=1)
    aim = (torch.rand(count, 3, generator=draws) - 0.5) * 0.8
    origin = aim - direction * (1.7 if unbounded else 2.6)
    background, jitter = torch.rand(count, 3, generator=draws), torch.rand(count, generator=draws)
    return Rays(
        origin.to(device).requires_grad_(),
        direction.to(device).requires_grad_(),
        background.to(device),
        jitter.to(device),
        trained,
    )


def random_marching(
    device: torch.device,
    *,
    step: float = 0.1,
    share: float = 0.4,
    most: int = 128,
    far: float = 12.0,
    merging: Merging | None = None,
) -> Marching:
    """A march through a grid of 8 x 8 x 8 cells, of which a share is occupied."""
    occupied = torch.rand(8, 8, 8, generator=torch.Generator().manual_seed(1)) < share
    return Marching(step, 0.1, far, most, occupied.to(torch.uint8).to(device), merging)


def learn(field: GridField, rays: Rays, marching: Marching, gradient: PositionGradient) -> Rendering:
    """Render the rays, and propagate a loss of colour and opacity back."""
    rendering = field.render(rays, marching, gradient)
    target = torch.linspace(0, 1, 3 * len(rays.origin), device=rays.origin.device).reshape(-1, 3)
    loss = ((rendering.colour - target) ** 2).mean() + 0.1 * (rendering.opacity**2).mean()
    loss.backward()  # type: ignore[no-untyped-call]
    return rendering


def cut(x: Tensor) -> Tensor:
    """float32 numbers without the last 13 bits of their mantissas."""
    return (x.contiguous().view(torch.int32) & ~0x1FFF).view(torch.float32)


class CutProduct(torch.autograd.Function):
    """a b of matrices, and its gradients, with factors that are cut."""

    @staticmethod
    def forward(ctx: Any, a: Tensor, b: Tensor) -> Tensor:
        ctx.save_for_backward(a, b)
        return cut(a) @ cut(b)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, Tensor]:
        a, b = ctx.saved_tensors
        g = cut(gradients[0])
        return g @ cut(b).T, cut(a).T @ g


class DefinedField(ReferenceField):
    """The definition of what the kernels compute on a device: on a GPU its products have factors that are cut."""

    def __init__(self, shape: FieldShape, seed: int, device: torch.device) -> None:
        super().__init__(shape, seed, device)
        if device.type == "cuda":
            self.product = CutProduct.apply
