"""The occupancy grid: which cells of the scene are not empty, so that ray marching can skip the others.

As NerfAcc and BAA-NGP: a running maximum of density times step, decaying by 0.95 per update; a cell is occupied
above min(mean, 0.01). Everything counts as occupied until the first update with `prune`.

The density is the field's estimate, as where intervals are merged: it costs a quarter, and the grid needs no more.
"""

from __future__ import annotations

import torch
from torch import Tensor

from biresnerf.field.radiance_field import RadianceField

DECAY = 0.95
THRESHOLD = 0.01
GROWTH_UP_TO = 60.0  # inner boxes: how far unbounded rays reach
DENSITY_CHUNK = 1 << 18  # cells evaluated at once


def interval_growth(position: Tensor) -> Tensor:
    """How many times longer than in the inner box an interval is at grid positions [n, 3] of an unbounded scene.

    m^2, with m the largest coordinate before contraction (see `reference.grid_position` and `reference.march`).
    """
    contracted = (4 * position - 2).abs().amax(1)
    m = 1 / (2 - contracted).clamp(min=1 / GROWTH_UP_TO)
    return torch.where(contracted > 1, m * m, torch.ones_like(m))


def dilated(occupied: Tensor) -> Tensor:
    """uint8 [side, side, side] with the 26 neighbours of every occupied cell, axis after axis.

    On a CPU fifty times faster than torch's pooling in three dimensions.
    """
    for axis in range(3):
        wider, inner = occupied.clone(), occupied.shape[axis] - 1
        wider.narrow(axis, 1, inner).bitwise_or_(occupied.narrow(axis, 0, inner))
        wider.narrow(axis, 0, inner).bitwise_or_(occupied.narrow(axis, 1, inner))
        occupied = wider
    return occupied


class OccupancyGrid:
    """`occupied` is uint8 [side, side, side] over (z, y, x) of the grid position."""

    def __init__(self, side: int, device: torch.device) -> None:
        self.side, self.device = side, device
        self.thickness = torch.zeros(side**3, device=device)
        self.occupied = torch.ones(side, side, side, dtype=torch.uint8, device=device)

    def update(
        self,
        field: RadianceField,
        step: float,
        generator: torch.Generator,
        *,
        looked_at: float,
        prune: bool,
        dilate: bool,
    ) -> None:
        """Evaluate the occupied cells and a random share `looked_at` of the others, at a random point in each."""
        self._look(field, step, generator, looked_at)
        if prune:
            self._prune(dilate)

    def _look(self, field: RadianceField, step: float, generator: torch.Generator, looked_at: float) -> None:
        """Decay the running maximum, and raise it in the cells that are evaluated."""
        cells = torch.arange(self.side**3)
        if looked_at < 1:
            chosen = torch.rand(len(cells), generator=generator) < looked_at
            cells = cells[chosen | self.occupied.reshape(-1).cpu().bool()]
        self.thickness *= DECAY
        for part in cells.split(DENSITY_CHUNK):
            position = self._points(part, generator)
            density = field.estimate(position.to(self.device))
            part = part.to(self.device)
            length = step * interval_growth(position.to(self.device)) if field.unbounded else step
            self.thickness[part] = torch.maximum(self.thickness[part], density * length)

    def _points(self, cells: Tensor, generator: torch.Generator) -> Tensor:
        """A random point [n, 3] in each cell, on the generator's device."""
        index = torch.stack([cells % self.side, cells // self.side % self.side, cells // self.side**2], 1)
        return (index + torch.rand(len(cells), 3, generator=generator, device=generator.device)) / self.side

    def _prune(self, dilate: bool) -> None:
        bound = self.thickness.mean().clamp(max=THRESHOLD)
        occupied = (self.thickness > bound).to(torch.uint8).reshape(self.side, self.side, self.side)
        # A camera whose pose is still wrong needs density one cell away, or it gets no gradient.
        self.occupied = dilated(occupied) if dilate else occupied

    @property
    def share(self) -> float:
        """The share of cells that are occupied."""
        return float(self.occupied.float().mean())

    def state(self) -> dict[str, Tensor]:
        return {"thickness": self.thickness, "occupied": self.occupied}

    def load_state(self, state: dict[str, Tensor]) -> None:
        self.thickness.copy_(state["thickness"])
        self.occupied = state["occupied"].to(self.device).clone()  # not shared with a snapshot


class DeviceOccupancyGrid(OccupancyGrid):
    """The same rule without the host ever waiting for the number of cells; takes a generator on the grid's device."""

    def _look(self, field: RadianceField, step: float, generator: torch.Generator, looked_at: float) -> None:
        count = self.side**3
        cells = torch.arange(count, device=self.device)
        total = torch.full((1,), count, device=self.device)
        if looked_at < 1:
            chosen = torch.rand(count, generator=generator, device=self.device) < looked_at
            chosen |= self.occupied.reshape(-1).bool()
            place = torch.cumsum(chosen, 0)
            total = place[-1:]
            # The cells to evaluate come first; the rest is filled with the index of a cell that does not exist.
            first = torch.full((count + 1,), count, device=self.device)
            cells = first.scatter_(0, torch.where(chosen, place - 1, count), cells)[:count]
            cells = torch.where(torch.arange(count, device=self.device) < total, cells, count)
        found = torch.zeros(count + 1, device=self.device)
        for begin in range(0, count, DENSITY_CHUNK):
            part = cells[begin : begin + DENSITY_CHUNK]
            position = self._points(part.clamp(max=count - 1), generator)
            density = field.estimate(position, (total - begin).clamp(0, len(part)))
            length = step * interval_growth(position) if field.unbounded else step
            found.scatter_(0, part, density * length)
        self.thickness *= DECAY
        torch.maximum(self.thickness, found[:count], out=self.thickness)
