"""The occupancy grid that never queries the device for the number of cells to update, against the one that does."""

from __future__ import annotations

import pytest
import torch

from biresnerf.field.occupancy import DeviceOccupancyGrid, OccupancyGrid

DEVICE = torch.device("cuda" if torch.cuda.is_available() else "cpu")
SIDE = 16


class Ball:
    """Density 50 within a ball, 0 outside; what is asked for beyond `count` is answered with nonsense."""

    def __init__(self, unbounded: bool = False) -> None:
        self.unbounded = unbounded
        self.counts: list[int] = []

    def estimate(self, position: torch.Tensor, count: torch.Tensor | None = None) -> torch.Tensor:
        assert position.min() >= 0
        assert position.max() <= 1
        density = torch.where((position - 0.5).norm(dim=1) < 0.3, 50.0, 0.0)
        if count is None:
            return density
        self.counts.append(int(count))
        return torch.where(torch.arange(len(density), device=DEVICE) < count, density, float("nan"))


def update(grid, field, generator, **more) -> None:
    grid.update(field, 0.01, generator, **{"looked_at": 1.0, "prune": True, "dilate": False, **more})


@pytest.mark.parametrize("unbounded", [False, True])
@pytest.mark.parametrize("dilate", [False, True])
def test_looking_everywhere_gives_the_same_grid(unbounded, dilate):
    grids = OccupancyGrid(SIDE, DEVICE), DeviceOccupancyGrid(SIDE, DEVICE)
    for grid in grids:
        generator = torch.Generator(DEVICE).manual_seed(1)
        update(grid, Ball(unbounded), generator, dilate=dilate)
    slow, fast = grids
    torch.testing.assert_close(fast.thickness, slow.thickness)
    assert torch.equal(fast.occupied, slow.occupied)
    assert 0 < fast.share < 1


def test_a_partial_update_looks_at_the_occupied_cells_and_a_share_of_the_rest():
    grid, generator = DeviceOccupancyGrid(SIDE, DEVICE), torch.Generator(DEVICE).manual_seed(1)
    update(grid, Ball(), generator)
    occupied, before, field = grid.share, grid.thickness.clone(), Ball()
    update(grid, field, generator, looked_at=0.25)
    expected = SIDE**3 * (occupied + 0.25 * (1 - occupied))
    assert sum(field.counts) == pytest.approx(expected, rel=0.05)
    assert torch.isfinite(grid.thickness).all()
    outside = before == 0
    assert (grid.thickness[~outside] > 0).all()
    deep = before.reshape(SIDE, SIDE, SIDE)[7:9, 7:9, 7:9]
    torch.testing.assert_close(grid.thickness.reshape(SIDE, SIDE, SIDE)[7:9, 7:9, 7:9], deep)  # found again


def test_new_matter_is_found_by_partial_updates():
    grid, generator = DeviceOccupancyGrid(SIDE, DEVICE), torch.Generator(DEVICE).manual_seed(1)
    grid.occupied.zero_()
    for _ in range(40):
        update(grid, Ball(), generator, looked_at=0.25)
    centre = (torch.arange(SIDE, device=DEVICE) + 0.5) / SIDE - 0.5
    z, y, x = torch.meshgrid(centre, centre, centre, indexing="ij")
    distance = (x * x + y * y + z * z).sqrt()
    diagonal = 3**0.5 / SIDE
    assert grid.occupied[distance < 0.3 - diagonal / 2].all()
    assert not grid.occupied[distance > 0.3 + diagonal / 2].any()
