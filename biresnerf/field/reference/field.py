"""The radiance field on the plain-torch operations: any device; the yardstick for the fast backends."""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

from biresnerf.field.grid_field import BETA1, BETA2, EPSILON, GridField
from biresnerf.field.grid_levels import GridLevels
from biresnerf.field.radiance_field import FieldShape, Marching, PositionGradient, Rays, Rendering
from biresnerf.field.reference import operations as reference
from biresnerf.field.spherical_harmonics import spherical_harmonics


class ReferenceField(GridField):
    """Backend `reference`."""

    backend = "reference"
    product = staticmethod(torch.matmul)  # of the networks

    def __init__(self, shape: FieldShape, seed: int, device: torch.device) -> None:
        super().__init__(shape, seed, device)
        self.pose_table.requires_grad_()
        self.reconstruction_table.requires_grad_()

    def _features(self, x: Tensor, gradient: PositionGradient) -> tuple[Tensor, list[Tensor]]:
        """Features [n, width] and the networks they go to."""
        low = reference.encode(x, self.pose_table, self.shape.pose_grid, gradient.pose_smoothing)
        if not self.reconstructing:
            return low, self.networks
        passed = x.detach() + gradient.reconstruction_share * (x - x.detach())
        grid, table = self.shape.reconstruction_grid, self.reconstruction_table
        high = reference.encode(passed, table, grid, gradient.reconstruction_smoothing)
        first = torch.cat([self.networks[0], self.reconstruction_columns], 1)
        return torch.cat([low, high], 1), [first, *self.networks[1:]]

    def render(self, rays: Rays, marching: Marching, gradient: PositionGradient) -> Rendering:
        with torch.no_grad():
            t, dt, ray = reference.march(
                rays.origin, rays.direction, rays.jitter, marching.occupied,
                marching.step, marching.near, marching.far, self.shape.unbounded, marching.most,
            )  # fmt: skip
            samples = len(ray)
            if marching.merging is not None:
                estimate = self.estimate(self._positions(rays, t, ray))
                t, dt, ray = reference.merge(estimate, t, dt, ray, rays.jitter, marching.merging)
        x = self._positions(rays, t, ray)
        view = spherical_harmonics(rays.direction)[ray]
        split = int((ray < rays.trained).sum())
        density, colour = self._sample(x[:split], view[:split], gradient, trained=True)
        if split < len(ray):
            rest = self._sample(x[split:], view[split:], gradient, trained=False)
            density, colour = torch.cat([density, rest[0]]), torch.cat([colour, rest[1]])
        rgb, opacity, depth = reference.composite(density, colour, t, dt, ray, rays.background)
        return Rendering(rgb, opacity, depth.detach(), samples)

    def _positions(self, rays: Rays, t: Tensor, ray: Tensor) -> Tensor:
        return reference.grid_position(rays.origin[ray] + t[:, None] * rays.direction[ray], self.unbounded)

    def _sample(
        self, x: Tensor, view: Tensor, gradient: PositionGradient, trained: bool
    ) -> tuple[Tensor, Tensor]:
        parameters = [*self.tables.values(), self.reconstruction_columns, *self.networks]
        for parameter in parameters:
            parameter.requires_grad_(trained)
        features, weights = self._features(x, gradient)
        result = reference.network(features, view, weights, self.product)
        for parameter in parameters:
            parameter.requires_grad_()
        return result

    @torch.no_grad()
    def density(self, position: Tensor) -> Tensor:
        return reference.density(*self._features(position, PositionGradient()), self.product)

    @torch.no_grad()
    def estimate(self, position: Tensor, count: Tensor | None = None) -> Tensor:
        features = reference.encode(position, self.pose_table, self.shape.pose_grid)
        return reference.density(features, self.networks, self.product)

    @torch.no_grad()
    def _update_table(self, name: str, rates: np.ndarray) -> None:
        table = self.tables[name]
        if table.grad is not None:
            adam_touched(table, table.grad, *self.moments[name], self.steps[name], rates, self.grids[name])


def adam_touched(
    table: Tensor,
    grad: Tensor,
    moment1: Tensor,
    moment2: Tensor,
    step: int,
    rates: np.ndarray,
    grid: GridLevels,
) -> None:
    """Adam (Kingma & Ba 2015) in place on the numbers whose gradient is not zero; `rates` per level, 0 = left alone."""
    for level in range(grid.levels):
        if rates[level] == 0:
            continue
        rows = slice(int(grid.offset[level]), int(grid.offset[level + 1]))
        p, g, m, v = table[rows], grad[rows], moment1[rows], moment2[rows]
        touched = g != 0
        m_new = torch.where(touched, BETA1 * m + (1 - BETA1) * g, m)
        v_new = torch.where(touched, BETA2 * v + (1 - BETA2) * g * g, v)
        denominator = v_new.sqrt() / math.sqrt(1 - BETA2**step) + EPSILON
        update = float(rates[level]) * (m_new / (1 - BETA1**step)) / denominator
        p -= torch.where(touched, update, torch.zeros_like(update))
        m.copy_(m_new)
        v.copy_(v_new)
