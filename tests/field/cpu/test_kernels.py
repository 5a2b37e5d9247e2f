"""The CPU backend at its edges: borders, empty and odd batches, workers, repetition, and gradients to poses."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from biresnerf.field.cpu.field import CpuField
from biresnerf.field.grid_levels import grid_levels
from biresnerf.field.radiance_field import FieldRates, FieldShape, Marching, PositionGradient, Rays
from biresnerf.field.reference import operations as reference
from biresnerf.field.reference.field import ReferenceField
from biresnerf.geometry.lie import so3_exp

CPU = torch.device("cpu")
FULL = torch.ones(8, 8, 8, dtype=torch.uint8)
MARCHING = Marching(step=0.04, near=0.05, far=10.0, most=256, occupied=FULL)
RATES = FieldRates(0.01, 0.005, (0.01,) * 4, 0.003)


def make(kind, unbounded: bool = False, **more):
    shape = FieldShape(grid_levels(3, 8, 20, 14), grid_levels(4, 16, 60, 12), unbounded)
    field = kind(shape, 3, CPU, **more)
    generator = torch.Generator().manual_seed(5)
    with torch.no_grad():
        for tensor in (field.pose_table, field.reconstruction_table, field.reconstruction_columns):
            tensor.copy_(torch.rand(tensor.shape, generator=generator) - 0.5)
    field.start_reconstruction()
    return field


def rays(count: int, trained: int | None = None) -> Rays:
    generator = torch.Generator().manual_seed(7)
    direction = torch.nn.functional.normalize(torch.randn(count, 3, generator=generator), dim=1)
    origin = (torch.rand(count, 3, generator=generator) - 0.5) - 2.5 * direction
    background = torch.rand(count, 3, generator=generator)
    jitter = torch.rand(count, generator=generator)
    return Rays(
        origin.requires_grad_(),
        direction.requires_grad_(),
        background,
        jitter,
        count if trained is None else trained,
    )


BORDER = [-1.0, -0.5, -1e-7, 0.0, 1e-7, 0.25, 0.5, 1 - 1e-7, 1.0, 1.0 + 1e-7, 2.0]


def test_positions_on_and_outside_the_border_read_the_table_within_its_bounds():
    fast, slow = make(CpuField, workers=2), make(ReferenceField)
    values = torch.tensor(BORDER)
    x = torch.stack(torch.meshgrid(values, values, values, indexing="ij"), -1).reshape(-1, 3)
    inside = x.clamp(reference.EDGE, 1 - reference.EDGE)  # what the march hands on
    torch.testing.assert_close(fast.density(inside), slow.density(inside), rtol=1e-3, atol=1e-4)
    assert torch.isfinite(fast.density(inside)).all()


@pytest.mark.parametrize("unbounded", [False, True])
def test_rays_along_the_border_and_from_far_outside_give_finite_colours_and_gradients(unbounded):
    field = make(CpuField, unbounded, workers=2)
    origin = torch.tensor(
        [[-1.0, 1.0, 1.0], [-1.0, -1.0, -1.0], [1e6, 0, 0], [0, 0, 0], [1, 1, 1], [-5, 1 + 1e-6, 0]]
    ).requires_grad_()
    direction = torch.tensor(
        [[1.0, 0, 0], [0, 0, 1], [-1, 0, 0], [0, -1, 0], [0.6, 0.8, 0], [1, 0, 0]]
    ).requires_grad_()
    given = Rays(origin, direction, torch.ones(6, 3), torch.full((6,), 0.5), 6)
    rendering = field.render(given, Marching(0.04, 0.05, 60.0, 256, FULL), PositionGradient(1, 1, 1))
    (rendering.colour**2).sum().backward()
    for tensor in (rendering.colour, rendering.depth, origin.grad, direction.grad):
        assert torch.isfinite(tensor).all()
    assert rendering.colour.min() >= -1e-6
    assert rendering.colour.max() <= 1 + 1e-6


def test_no_rays_at_all_give_nothing():
    field = make(CpuField, workers=2)
    given = rays(0)
    rendering = field.render(given, MARCHING, PositionGradient())
    assert rendering.colour.shape == (0, 3)
    assert rendering.samples == 0
    rendering.colour.sum().backward()
    assert given.origin.grad.shape == (0, 3)
    field.step(RATES)


@pytest.mark.parametrize("count", [1, 2, 7, 31, 33])
def test_few_and_odd_batches_equal_the_reference(count):
    results = []
    for field in (make(CpuField, workers=2), make(ReferenceField)):
        given = rays(count)
        rendering = field.render(given, MARCHING, PositionGradient())
        (rendering.colour**2).sum().backward()
        results.append((rendering, given, field))
    (fast, fast_rays, _), (slow, slow_rays, _) = results
    torch.testing.assert_close(fast.colour, slow.colour, atol=2e-4, rtol=0)
    torch.testing.assert_close(fast.depth, slow.depth, atol=2e-3, rtol=0)
    scale = float(slow_rays.origin.grad.abs().max())
    # A sample on a cell face may fall to either side: the typical ray decides.
    assert float((fast_rays.origin.grad - slow_rays.origin.grad).abs().amax(1).median()) < 1e-3 * scale


def test_a_single_sample_is_rendered_and_learnt_from():
    field = make(CpuField, workers=2)
    rendering = field.render(rays(1), Marching(0.04, 0.05, 10.0, 1, FULL), PositionGradient())
    assert rendering.samples == 1
    before = field.pose_table.clone()
    (rendering.colour**2).sum().backward()
    field.step(RATES)
    changed = (field.pose_table != before).any(1)
    assert 0 < int(changed.sum()) <= 3 * 8  # eight vertices a level


def three_steps(workers: int) -> dict[str, torch.Tensor]:
    field = make(CpuField, workers=workers)
    for _ in range(3):
        given = rays(101, 70)
        rendering = field.render(given, MARCHING, PositionGradient(1, 0.5, 0.5))
        ((rendering.colour - 0.3) ** 2).mean().backward()
        field.step(RATES)
    return {**field.state(), "colour": rendering.colour.detach(), "gradient": given.origin.grad}


def test_the_same_steps_give_the_same_bits():
    one, other = three_steps(2), three_steps(2)
    for name, tensor in one.items():
        assert torch.equal(tensor, other[name]), name


@pytest.mark.parametrize("workers", [1, 5])
def test_the_number_of_workers_does_not_change_a_bit(workers):
    one, other = three_steps(2), three_steps(workers)
    for name, tensor in one.items():
        assert torch.equal(tensor, other[name]), name


def smooth_field() -> CpuField:
    """Features that are almost linear across the scene: no cell face is felt, so differences are derivatives."""
    shape = FieldShape(grid_levels(1, 8, 8, 14), grid_levels(1, 16, 16, 12), False)
    field = CpuField(shape, 3, CPU, workers=2)
    stride = int(shape.pose_grid.stride[0])
    index = torch.arange(stride**3)
    vertex = (
        torch.stack([index % stride, index // stride % stride, index // stride**2], 1).float() / stride - 0.5
    )
    with torch.no_grad():
        field.pose_table[: len(vertex)] = vertex @ torch.tensor([[2.0, -1.0], [1.0, 1.5], [-1.5, 2.0]])
    return field


@pytest.mark.parametrize("what", ["rotation", "translation"])
def test_the_gradient_to_a_pose_equals_finite_differences(what):
    field = smooth_field()
    generator = torch.Generator().manual_seed(1)
    in_cam = torch.nn.functional.normalize(
        torch.cat([(torch.rand(200, 2, generator=generator) - 0.5) * 0.3, torch.ones(200, 1)], 1), dim=1
    )
    target = torch.rand(200, 3, generator=generator)
    # No sample may enter or leave while the pose moves: start and end lie within the box.
    marching = Marching(0.02, 1.9, 2.7, 256, FULL)

    def loss(increment: torch.Tensor) -> torch.Tensor:
        turn = increment if what == "rotation" else torch.zeros(3)
        shift = increment if what == "translation" else torch.zeros(3)
        direction = in_cam @ so3_exp(turn).T
        origin = (torch.tensor([0.1, -0.05, -2.3]) + shift).expand(200, 3).contiguous()
        given = Rays(origin, direction.contiguous(), torch.ones(200, 3), torch.full((200,), 0.5), 0)
        return ((field.render(given, marching, PositionGradient()).colour - target) ** 2).sum()

    increment = torch.zeros(3, requires_grad=True)
    loss(increment).backward()
    step = 4e-3
    numeric = [
        float(loss(step * axis).detach() - loss(-step * axis).detach()) / (2 * step) for axis in torch.eye(3)
    ]
    assert np.abs(numeric).max() > 0.05
    np.testing.assert_allclose(increment.grad.numpy(), numeric, atol=0.02 * np.abs(numeric).max())


def test_rays_that_are_not_trained_on_leave_the_field_alone():
    field = make(CpuField, workers=2)
    before = {name: tensor.clone() for name, tensor in field.state().items()}
    given = rays(40, trained=0)
    rendering = field.render(given, MARCHING, PositionGradient())
    (rendering.colour**2).sum().backward()
    assert given.origin.grad.abs().max() > 0
    field.step(RATES)
    for name in ("pose_table", "reconstruction_table", "network0", "network4", "reconstruction_columns"):
        assert torch.equal(field.state()[name], before[name]), name


def test_a_level_with_rate_zero_stays_as_it_is():
    field = make(CpuField, workers=2)
    field.start_reconstruction()
    with torch.no_grad():
        field.reconstruction_columns.fill_(0.1)  # at zero, as they start, no gradient reaches the table
    grid, before = field.shape.reconstruction_grid, field.reconstruction_table.clone()
    rendering = field.render(rays(60), MARCHING, PositionGradient())
    (rendering.colour**2).sum().backward()
    field.step(FieldRates(0.01, 0.005, (0.01, 0.0, 0.01, 0.0), 0.003))
    changed = [
        bool((field.reconstruction_table != before)[grid.offset[level] : grid.offset[level + 1]].any())
        for level in range(4)
    ]
    assert changed == [True, False, True, False]
