"""The field's step in plain torch as fast as torch can be written to do it: what the kernels are measured against.

Two forms of the encodings: all levels and corners at once (`VectorisedField`), and eight corners unrolled, the fastest
without a compiler (`UnrolledField`). March and table update are vectorised in both, unlike the definition's, which is
written to be read.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from biresnerf.field.grid_field import BETA1, BETA2, EPSILON
from biresnerf.field.grid_levels import HASH_PRIMES, GridLevels
from biresnerf.field.radiance_field import FieldShape, Marching, PositionGradient, Rays, Rendering
from biresnerf.field.reference import operations as reference
from biresnerf.field.reference.field import ReferenceField
from biresnerf.field.spherical_harmonics import spherical_harmonics

_CORNERS = torch.tensor([[k & 1, (k >> 1) & 1, k >> 2] for k in range(8)])


def _cells(x: Tensor, grid: GridLevels, smoothing: float) -> tuple[Tensor, Tensor]:
    """Cell [n, levels, 3] and fraction within it."""
    position = x[:, None] * torch.from_numpy(grid.scale)[:, None] + 0.5
    cell = position.detach().floor()
    return cell.long(), reference.straight_through_fraction(position - cell, smoothing)


def _indices(x: Tensor, y: Tensor, z: Tensor, grid: GridLevels) -> Tensor:
    """Table rows of vertices [n, levels(, 8)]."""
    if grid.hashed.all():
        size = int(grid.offset[1] - grid.offset[0])
        within = (x ^ (y * HASH_PRIMES[1]) ^ (z * HASH_PRIMES[2])) & (size - 1)
    elif not grid.hashed.any():
        stride = torch.from_numpy(grid.stride.astype(np.int64)).reshape(-1, *[1] * (x.ndim - 2))
        within = x + stride * (y + stride * z)
    else:
        raise ValueError("levels must be all hashed or all dense")
    return within + torch.from_numpy(grid.offset[:-1]).reshape(-1, *[1] * (x.ndim - 2))


def encode_unrolled(x: Tensor, table: Tensor, grid: GridLevels, smoothing: float = 0.0) -> Tensor:
    """`reference.encode` with all levels at once and the corners one after another."""
    cell, fraction = _cells(x, grid, smoothing)
    total = torch.zeros(len(x), grid.levels, 2)
    for bits in _CORNERS.tolist():
        x_, y, z = (cell[..., axis] + bits[axis] for axis in range(3))
        weight = 1.0
        for axis in range(3):
            weight = weight * (fraction[..., axis] if bits[axis] else 1 - fraction[..., axis])
        total = total + weight[..., None] * table[_indices(x_, y, z, grid)]
    return total.flatten(1)


def encode_vectorised(x: Tensor, table: Tensor, grid: GridLevels, smoothing: float = 0.0) -> Tensor:
    """`reference.encode` with all levels and corners at once."""
    cell, fraction = _cells(x, grid, smoothing)
    vertex = cell[:, :, None] + _CORNERS
    weight = torch.where(_CORNERS.bool(), fraction[:, :, None], 1 - fraction[:, :, None]).prod(-1)
    index = _indices(vertex[..., 0], vertex[..., 1], vertex[..., 2], grid)
    return (table[index] * weight[..., None]).sum(2).flatten(1)


def march_at_once(rays: Rays, marching: Marching) -> tuple[Tensor, Tensor, Tensor]:
    """`reference.march` of a bounded scene, all intervals of all rays at once."""
    origin, direction = rays.origin, rays.direction
    safe = torch.where(direction.abs() < 1e-9, torch.full_like(direction, 1e-9), direction)
    ta, tb = (-1 - origin) / safe, (1 - origin) / safe
    t = torch.minimum(ta, tb).amax(1).clamp(min=marching.near)
    t_end = torch.maximum(ta, tb).amin(1).clamp(max=marching.far)
    count = int(((t_end - t).amax() / marching.step).clamp(min=0)) + 1
    middle = t[:, None] + (torch.arange(count) + 0.5 + rays.jitter[:, None]) * marching.step
    side = marching.occupied.shape[0]
    point = origin[:, None] + middle[..., None] * direction[:, None]
    cell = ((point / 2 + 0.5) * side).long().clamp(0, side - 1)
    live = marching.occupied[cell[..., 2], cell[..., 1], cell[..., 0]].bool() & (middle < t_end[:, None])
    ray, at = live.nonzero(as_tuple=True)
    return middle[ray, at], torch.full((len(ray),), marching.step), ray


class UnrolledField(ReferenceField):
    """The fastest plain-torch form."""

    backend = "torch, corners unrolled"
    encode = staticmethod(encode_unrolled)

    def __init__(self, shape: FieldShape, seed: int, device: torch.device) -> None:
        super().__init__(shape, seed, device)
        self._table_adam = {
            name: torch.optim.Adam([table], betas=(BETA1, BETA2), eps=EPSILON, fused=True)
            for name, table in self.tables.items()
        }

    def _features(self, x: Tensor, gradient: PositionGradient) -> Tensor:
        low = self.encode(x, self.pose_table, self.shape.pose_grid, gradient.pose_smoothing)
        if not self.reconstructing:
            return low
        passed = x.detach() + gradient.reconstruction_share * (x - x.detach())
        grid, table = self.shape.reconstruction_grid, self.reconstruction_table
        return torch.cat([low, self.encode(passed, table, grid, gradient.reconstruction_smoothing)], 1)

    def render(self, rays: Rays, marching: Marching, gradient: PositionGradient) -> Rendering:
        with torch.no_grad():
            t, dt, ray = march_at_once(rays, marching)
        x = reference.grid_position(rays.origin[ray] + t[:, None] * rays.direction[ray], unbounded=False)
        view = spherical_harmonics(rays.direction)[ray]
        first = self.networks[0]
        if self.reconstructing:
            first = torch.cat([first, self.reconstruction_columns], 1)
        weights = [first, *self.networks[1:]]
        density, colour = reference.network(self._features(x, gradient), view, weights)
        rgb, opacity, depth = reference.composite(density, colour, t, dt, ray, rays.background)
        return Rendering(rgb, opacity, depth.detach(), len(ray))

    def _update_table(self, name: str, rates: np.ndarray) -> None:
        self._table_adam[name].param_groups[0]["lr"] = float(rates[0])
        self._table_adam[name].step()


class VectorisedField(UnrolledField):
    """Everything at once, as torch code is usually written."""

    backend = "torch, vectorised"
    encode = staticmethod(encode_vectorised)
