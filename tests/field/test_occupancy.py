"""The occupancy grid on a field whose density is known."""

from __future__ import annotations

import pytest
import torch

from biresnerf.field.occupancy import DECAY, OccupancyGrid, dilated

CPU = torch.device("cpu")
SIDE = 8


class Slab:
    """A density of 50 where x of the grid position is in the fourth eighth, else `elsewhere`."""

    unbounded = False

    def __init__(self, elsewhere: float = 0.0) -> None:
        self.elsewhere, self.asked = elsewhere, 0

    def estimate(self, position: torch.Tensor) -> torch.Tensor:
        self.asked += len(position)
        assert position.min() >= 0
        assert position.max() <= 1
        inside = (position[:, 0] >= 3 / 8) & (position[:, 0] < 4 / 8)
        return torch.where(inside, 50.0, self.elsewhere)


def update(grid: OccupancyGrid, field: Slab, *, looked_at=1.0, prune=True, dilate=False, seed=0) -> None:
    generator = torch.Generator().manual_seed(seed)
    grid.update(field, 0.01, generator, looked_at=looked_at, prune=prune, dilate=dilate)


def columns(grid: OccupancyGrid) -> list[int]:
    """Which x are occupied, for all y and z alike."""
    across = grid.occupied.float().mean((0, 1))
    assert set(across.tolist()) <= {0.0, 1.0}
    return across.nonzero()[:, 0].tolist()


def test_cells_with_density_are_occupied_and_they_alone():
    grid = OccupancyGrid(SIDE, CPU)
    update(grid, Slab())
    assert columns(grid) == [3]
    assert grid.share == pytest.approx(1 / 8)
    assert grid.thickness.max() == pytest.approx(0.5)  # density times step


def test_dilation_adds_the_neighbours():
    grid = OccupancyGrid(SIDE, CPU)
    update(grid, Slab(), dilate=True)
    assert columns(grid) == [2, 3, 4]


def test_dilation_takes_all_26_neighbours_and_stops_at_the_border():
    cells = (torch.rand(9, 9, 9, generator=torch.Generator().manual_seed(2)) < 0.05).to(torch.uint8)
    pooled = torch.nn.functional.max_pool3d(cells.float()[None, None], 3, stride=1, padding=1)[0, 0]
    assert torch.equal(dilated(cells), pooled.to(torch.uint8))


def test_nothing_is_pruned_before_it_is_asked_for():
    grid = OccupancyGrid(SIDE, CPU)
    assert grid.share == 1
    for seed in range(5):
        update(grid, Slab(), prune=False, seed=seed)
    assert grid.share == 1


def test_thin_matter_counts_where_all_is_thin():
    grid = OccupancyGrid(SIDE, CPU)
    update(grid, Slab(elsewhere=1e-4))
    assert columns(grid) == [3]
    thin = Slab(elsewhere=0.5)  # thickness 0.005: below 0.01 yet not empty
    thin.estimate = lambda position: torch.where(position[:, 0] < 0.5, 0.5, 0.0)
    grid = OccupancyGrid(SIDE, CPU)
    update(grid, thin)
    assert columns(grid) == [0, 1, 2, 3]


def test_what_has_gone_is_forgotten_by_and_by():
    grid = OccupancyGrid(SIDE, CPU)
    update(grid, Slab())
    gone = Slab()
    gone.estimate = lambda position: torch.where(position[:, 0] < 1 / 8, 50.0, 0.0)
    needed = 0
    while 3 in columns(grid):
        update(grid, gone)
        needed += 1
    assert 0.5 * DECAY**needed <= 0.01 < 0.5 * DECAY ** (needed - 1)


def test_a_partial_update_looks_at_the_occupied_and_a_quarter_of_the_rest():
    grid = OccupancyGrid(16, CPU)
    update(grid, Slab())
    field = Slab()
    update(grid, field, looked_at=0.25)
    expected = 16**3 * (1 / 8 + 7 / 8 / 4)
    assert field.asked == pytest.approx(expected, rel=0.1)


def test_new_matter_is_found_by_partial_updates():
    grid = OccupancyGrid(SIDE, CPU)
    empty = Slab()
    empty.estimate = lambda position: torch.where(position[:, 0] > 7 / 8, 50.0, 0.0)
    update(grid, empty)
    assert columns(grid) == [7]
    generator = torch.Generator().manual_seed(0)
    for _ in range(40):
        grid.update(Slab(), 0.01, generator, looked_at=0.25, prune=True, dilate=False)
    assert 3 in columns(grid)


def test_a_restored_grid_is_the_same_and_shares_nothing():
    grid = OccupancyGrid(SIDE, CPU)
    update(grid, Slab())
    other = OccupancyGrid(SIDE, CPU)
    other.load_state(grid.state())
    assert torch.equal(other.occupied, grid.occupied)
    assert torch.equal(other.thickness, grid.thickness)
    other.occupied.zero_()
    other.thickness.zero_()
    assert columns(grid) == [3]
    assert grid.thickness.max() > 0
