"""A random field, rays and occupancy grid on which backends are compared; the same on every device."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

import torch

from biresnerf.field.grid_field import GridField
from biresnerf.field.radiance_field import FieldShape, Marching, Merging, PositionGradient, Rays, Rendering

Field = TypeVar("Field", bound=GridField)
MakeField = Callable[[FieldShape, int, torch.device], GridField]


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
