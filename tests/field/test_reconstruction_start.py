"""How the reconstruction module joins: what the switch changes, and what is restored."""

from __future__ import annotations

import pytest
import torch

from biresnerf.field.grid_field import GridField
from biresnerf.field.grid_levels import grid_levels
from biresnerf.field.radiance_field import FieldRates, FieldShape, PositionGradient
from biresnerf.field.reference.field import ReferenceField
from tests.field.test_coarse_to_fine import MARCHING, rays

CPU = torch.device("cpu")
RATES = FieldRates(1e-2, 1e-2, (1e-2,) * 4, 1e-2)


def made() -> ReferenceField:
    field = ReferenceField(FieldShape(grid_levels(3, 6, 16, 14), grid_levels(4, 20, 60, 11), False), 3, CPU)
    with torch.no_grad():
        for seed, table in enumerate((field.pose_table, field.reconstruction_table)):
            table.uniform_(-0.5, 0.5, generator=torch.Generator().manual_seed(seed))
    return field


def colours(field: GridField) -> torch.Tensor:
    with torch.no_grad():
        return field.render(rays(), MARCHING, PositionGradient()).colour


def step(field: GridField) -> None:
    field.render(rays(), MARCHING, PositionGradient()).colour.square().sum().backward()
    field.step(RATES if field.reconstructing else FieldRates(1e-2, 1e-2, (), 0.0))


def test_joining_changes_no_picture_at_the_switch_and_every_one_after_it():
    field = made()
    step(field)
    before = colours(field)
    density = field.density(torch.rand(20, 3, generator=torch.Generator().manual_seed(1)))
    field.start_reconstruction()
    torch.testing.assert_close(colours(field), before)
    torch.testing.assert_close(
        field.density(torch.rand(20, 3, generator=torch.Generator().manual_seed(1))), density
    )
    step(field)
    step(field)
    assert float((colours(field) - before).abs().max()) > 1e-3


@pytest.mark.parametrize("after_switch", [False, True])
def test_a_restored_field_goes_on_alike_before_and_after_the_switch(after_switch):
    def go_on(field: GridField) -> None:
        if not field.reconstructing:
            field.start_reconstruction()
        step(field)

    first = made()
    step(first)
    if after_switch:
        go_on(first)
    saved = {name: tensor.clone() for name, tensor in first.state().items()}
    go_on(first)
    second = made()
    second.load_state(saved)
    go_on(second)
    for name, tensor in first.state().items():
        assert torch.equal(second.state()[name], tensor), name
