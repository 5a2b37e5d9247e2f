"""Occupancy measures a cell of an unbounded scene by the interval that marching would take there."""

from __future__ import annotations

import torch

from biresnerf.field.occupancy import interval_growth
from biresnerf.field.reference import operations as reference


def test_cells_are_judged_by_the_length_of_the_intervals_that_cross_them():
    step, side = 1e-3, 4
    origin, direction = torch.zeros(1, 3).double(), torch.tensor([[0.6, 0.0, 0.8]]).double()
    occupied = torch.ones(side, side, side, dtype=torch.uint8)
    t, dt, _ = reference.march(
        origin, direction, torch.zeros(1).double(), occupied, step, 0.0, 40.0, True, 10**6
    )
    # An interval's length is decided where it begins.
    start = origin + (t - dt / 2)[:, None] * direction
    growth = interval_growth(reference.grid_position(start, True))
    assert float(dt.max()) > 500 * step
    torch.testing.assert_close(step * growth, dt, rtol=1e-3, atol=0)
