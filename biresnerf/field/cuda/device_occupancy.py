"""The occupancy grid on a GPU: the same rule, without the host ever asking how many cells it concerns."""

from __future__ import annotations

import torch

from biresnerf.field.occupancy import DECAY, DENSITY_CHUNK, OccupancyGrid, interval_growth
from biresnerf.field.radiance_field import RadianceField


class DeviceOccupancyGrid(OccupancyGrid):
    """`update` takes a generator on the grid's own device."""

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
        count = self.side**3
        cells = torch.arange(count, device=self.device)
        total = torch.full((1,), count, device=self.device)
        if looked_at < 1:
            chosen = torch.rand(count, generator=generator, device=self.device) < looked_at
            chosen |= self.occupied.reshape(-1).bool()
            place = torch.cumsum(chosen, 0)
            total = place[-1:]
            # The cells to look at come first; behind them lies a cell of no meaning, as often as needed.
            first = torch.full((count + 1,), count, device=self.device)
            cells = first.scatter_(0, torch.where(chosen, place - 1, count), cells)[:count]
            cells = torch.where(torch.arange(count, device=self.device) < total, cells, count)
        found = torch.zeros(count + 1, device=self.device)
        for begin in range(0, count, DENSITY_CHUNK):
            part = cells[begin : begin + DENSITY_CHUNK]
            position = self._points(part.clamp(max=count - 1), generator)
            density = field.density_of_first((total - begin).clamp(0, len(part)), position)
            length = step * interval_growth(position) if field.unbounded else step
            found.scatter_(0, part, density * length)
        self.thickness *= DECAY
        torch.maximum(self.thickness, found[:count], out=self.thickness)
        if prune:
            self._prune(dilate)
