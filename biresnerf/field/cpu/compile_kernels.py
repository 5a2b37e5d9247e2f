"""Compile the kernels of the field, or load them from Numba's cache."""

from __future__ import annotations

import torch

from biresnerf.field.cpu.field import CpuField
from biresnerf.field.grid_levels import grid_levels
from biresnerf.field.radiance_field import FieldRates, FieldShape, Marching, Merging, PositionGradient, Rays


def compile_field_kernels(*, backward: bool = True) -> None:
    """Every kernel once on a tiny field, on the way a step takes; or only what renders."""
    shape = FieldShape(grid_levels(2, 4, 8, 10), grid_levels(2, 16, 32, 10), unbounded=False)
    field = CpuField(shape, 0, torch.device("cpu"), workers=1)
    field.start_reconstruction()
    origin = torch.tensor([[0.0, 0.0, -2.0]], requires_grad=True)
    direction = torch.tensor([[0.0, 0.0, 1.0]], requires_grad=True)
    rays = Rays(origin, direction, torch.ones(1, 3), torch.zeros(1), trained=1)
    occupied = torch.ones(
        8, 8, 8, dtype=torch.uint8
    )  # of two blocks a side: of one, a reversed view is laid out alike
    marching = Marching(0.1, 0.1, 10.0, 64, occupied, Merging(light=0.03, most=8))
    colour = field.render(rays, marching, PositionGradient()).colour
    field.density(torch.full((1, 3), 0.5))
    if backward:
        colour.sum().backward()
        field.step(FieldRates(1e-3, 1e-3, (1e-3,) * 2, 1e-3))
