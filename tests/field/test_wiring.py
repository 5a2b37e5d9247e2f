"""How the reconstruction module joins: what the switch changes, what learns after it, and what is restored."""

from __future__ import annotations

import pytest
import torch

from biresnerf.field.backends import make_field
from biresnerf.field.cpu.field import CpuField
from biresnerf.field.grid_field import GridField
from biresnerf.field.grid_levels import grid_levels
from biresnerf.field.radiance_field import FieldRates, FieldShape, PositionGradient
from biresnerf.field.reference import operations as reference
from biresnerf.field.reference.field import ReferenceField
from tests.field.test_coarse_to_fine import MARCHING, rays

CPU = torch.device("cpu")
RATES = FieldRates(1e-2, 1e-2, (1e-2,) * 4, 1e-2)


def made(wiring: str, backend: type = ReferenceField) -> GridField:
    shape = FieldShape(grid_levels(3, 6, 16, 14), grid_levels(4, 20, 60, 11), False, wiring=wiring)
    field = backend(shape, 3, CPU) if backend is ReferenceField else backend(shape, 3, CPU, workers=1)
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


def learnt(field: GridField, act) -> set[str]:
    """The names of state tensors that `act` changes."""
    before = {name: tensor.clone() for name, tensor in field.state().items()}
    act()
    after = field.state()
    return {name for name, tensor in before.items() if not torch.equal(after[name], tensor)}


@pytest.mark.parametrize("wiring", ["concat", "residual"])
def test_joining_beside_or_on_top_changes_no_picture_at_the_switch_and_every_one_after_it(wiring):
    field = made(wiring)
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


def test_taking_the_place_of_the_pose_module_leaves_nothing_of_what_it_knew():
    field = made("replace")
    step(field)
    field.start_reconstruction()
    before = colours(field)
    with torch.no_grad():
        field.pose_table.uniform_(-5, 5, generator=torch.Generator().manual_seed(9))
    assert torch.equal(colours(field), before)
    features = reference.encode(
        torch.rand(30, 3, generator=torch.Generator().manual_seed(1)),
        field.reconstruction_table,
        field.shape.reconstruction_grid,
    )
    logit = (torch.relu(features @ field.reconstruction_columns.T) @ field.networks[1].T)[:, 0]
    x = torch.rand(30, 3, generator=torch.Generator().manual_seed(1))
    torch.testing.assert_close(field.density(x), reference.density_of(logit).detach())
    changed = learnt(field, lambda: step(field))
    assert not changed & {"pose_table", "network0"}
    assert {"reconstruction_table", "reconstruction_columns", "network1", "network4"} <= changed


def test_the_outputs_of_both_networks_are_added_before_density_and_colour():
    field = made("residual")
    field.start_reconstruction()
    with torch.no_grad():
        for weight in field.reconstruction_head:
            weight.uniform_(-0.4, 0.4, generator=torch.Generator().manual_seed(5))
    x = torch.rand(30, 3, generator=torch.Generator().manual_seed(1))
    view = torch.rand(30, 16, generator=torch.Generator().manual_seed(2))
    grids = field.shape.pose_grid, field.shape.reconstruction_grid
    tables = field.pose_table, field.reconstruction_table
    low, high = (reference.encode(x, table, grid) for table, grid in zip(tables, grids, strict=True))
    a = reference.network_logits(low, view, field.networks)
    b = reference.network_logits(high, view, [field.reconstruction_columns, *field.reconstruction_head])
    density, colour = field._sample(x, view, PositionGradient(), trained=True)
    torch.testing.assert_close(density, torch.exp(a[0] + b[0] - 1))
    torch.testing.assert_close(colour, torch.sigmoid(a[1] + b[1]))
    torch.testing.assert_close(field.density(x), density.detach())
    changed = learnt(field, lambda: step(field))
    assert {"pose_table", "network0", "reconstruction_table", "reconstruction_columns"} <= changed
    assert {f"reconstruction_head{i}" for i in range(4)} <= changed


def test_the_kernels_replace_as_the_definition_does():
    fields = made("replace"), made("replace", CpuField)
    for field in fields:
        field.start_reconstruction()
    torch.testing.assert_close(colours(fields[0]), colours(fields[1]), rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("wiring", ["concat", "replace", "residual"])
@pytest.mark.parametrize("after_switch", [False, True])
def test_a_restored_field_goes_on_alike_before_and_after_the_switch(wiring, after_switch):
    def go_on(field: GridField) -> None:
        if not field.reconstructing:
            field.start_reconstruction()
        step(field)

    first = made(wiring)
    step(first)
    if after_switch:
        go_on(first)
    saved = {name: tensor.clone() for name, tensor in first.state().items()}
    go_on(first)
    second = made(wiring)
    second.load_state(saved)
    go_on(second)
    for name, tensor in first.state().items():
        assert torch.equal(second.state()[name], tensor), name


def test_two_heads_run_on_plain_torch_whatever_the_device():
    shape = FieldShape(grid_levels(2, 4, 8, 10), grid_levels(2, 16, 32, 10), False, wiring="residual")
    assert make_field(shape, 0, CPU, 1).backend == "reference"
