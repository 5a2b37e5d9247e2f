"""The windows of BARF and BAA-NGP against their formulas, and a hash grid that opens level by level."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from biresnerf.field.coarse_to_fine import band_weights, level_mixing, level_weights
from biresnerf.field.cpu.field import CpuField
from biresnerf.field.grid_field import GridField
from biresnerf.field.grid_levels import grid_levels
from biresnerf.field.radiance_field import FieldRates, FieldShape, Marching, PositionGradient, Rays
from biresnerf.field.reference import operations as reference
from biresnerf.field.reference.field import ReferenceField

CPU = torch.device("cpu")
STEPS, LEVELS = 40_000, 16
HALF_OPEN = 0.27  # of the run: between two levels


def test_before_the_window_all_are_closed_but_the_coarsest_level_and_after_it_all_are_open():
    assert band_weights(0.1, 10).tolist() == [0.0] * 10
    assert level_weights(0.1, LEVELS).tolist() == [1.0] + [0.0] * 15
    assert band_weights(0.5, 10) == pytest.approx([1.0] * 10)
    assert level_weights(0.5, LEVELS) == pytest.approx([1.0] * LEVELS)


@pytest.mark.parametrize("step", [4001, 4533, 5066, 5068, 9000, 12_345, 18_933, 18_935, 19_999])
def test_baa_ngp_opens_one_level_more_every_1067_of_its_40000_steps(step):
    active = int((level_weights(step / STEPS, LEVELS) > 0).sum())
    assert active == 1 + math.ceil((step - 4000) / (16_000 / 15))


def test_weights_rise_as_half_cosines_one_after_the_other():
    progress = 0.1 + 0.4 * 2.25 / 15  # a quarter of the way through the third of 15 levels
    quarter = (1 - math.cos(math.pi / 4)) / 2
    assert level_weights(progress, LEVELS)[:5] == pytest.approx([1, 1, 1, quarter, 0])
    assert band_weights(0.1 + 0.4 * 2.25 / 10, 10)[:4] == pytest.approx([1, 1, quarter, 0])


@pytest.mark.parametrize("progress", [0.0, 0.13, HALF_OPEN, 0.5, 1.0])
def test_closed_levels_repeat_the_finest_open_one(progress):
    features = np.random.default_rng(0).normal(size=(LEVELS, 3))
    weights = level_weights(progress, LEVELS)
    finest = max(level for level in range(LEVELS) if weights[level] > 0)
    expected = [w * f + (1 - w) * features[finest] for w, f in zip(weights, features, strict=True)]
    np.testing.assert_allclose(level_mixing(progress, LEVELS) @ features, expected)


def opening(backend: str, progress: float) -> GridField:
    """A field of one grid of six levels, its table large enough to matter."""
    shape = FieldShape(grid_levels(6, 6, 60, 11), grid_levels(0, 1, 1, 0), False, broadcast=True)
    made = ReferenceField(shape, 3, CPU) if backend == "reference" else CpuField(shape, 3, CPU, workers=1)
    with torch.no_grad():
        made.pose_table.uniform_(-0.5, 0.5, generator=torch.Generator().manual_seed(2))
    made.reach(progress)
    return made


def rays(count: int = 12) -> Rays:
    generator = torch.Generator().manual_seed(7)
    direction = torch.nn.functional.normalize(torch.randn(count, 3, generator=generator), dim=1)
    origin = 0.6 * (torch.rand(count, 3, generator=generator) - 0.5) - 2.6 * direction
    return Rays(
        origin.requires_grad_(),
        direction.requires_grad_(),
        torch.rand(count, 3, generator=generator),
        torch.rand(count, generator=generator),
        count,
    )


MARCHING = Marching(0.08, 0.1, 10.0, 128, torch.ones(8, 8, 8, dtype=torch.uint8))


def test_the_network_sees_the_mixed_features():
    made = opening("reference", HALF_OPEN)
    x = torch.rand(40, 3, generator=torch.Generator().manual_seed(1))
    features = reference.encode(x, made.pose_table, made.shape.pose_grid).reshape(40, 6, 2)
    mixing = torch.tensor(level_mixing(HALF_OPEN, 6), dtype=torch.float32)
    mixed = torch.einsum("kl,nlf->nkf", mixing, features).reshape(40, 12)
    learnt = [made.state()[f"network{i}"] for i in range(2)]
    logit = (torch.relu(mixed @ learnt[0].T) @ learnt[1].T)[:, 0]
    torch.testing.assert_close(made.density(x), reference.density_of(logit))


@pytest.mark.parametrize("progress", [0.05, HALF_OPEN, 0.9])
def test_the_kernels_render_and_step_an_opening_grid_as_the_definition_does(progress):
    fields = [opening(backend, progress) for backend in ("reference", "cpu")]
    colours, gradients = [], []
    for made in fields:
        given = rays()
        rendering = made.render(given, MARCHING, PositionGradient())
        rendering.colour.square().sum().backward()
        made.step(FieldRates(1e-3, 1e-3, (), 0.0))
        colours.append(rendering.colour.detach())
        gradients.append(given.origin.grad)
    torch.testing.assert_close(*colours, rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(*gradients, rtol=2e-2, atol=2e-3 * float(gradients[0].abs().max()))
    # Adam's first step is the rate times the gradient's sign: few signs may differ, where gradients vanish.
    for i in range(5):
        first, second = (made.state()[f"network{i}"] for made in fields)
        assert float(((first - second).abs() > 2e-4).float().mean()) < 0.01
    tables = [made.state()["pose_table"] for made in fields]
    assert float(((tables[0] - tables[1]).abs() > 2e-4).float().mean()) < 0.01


def test_levels_that_are_closed_do_not_learn_but_the_finest_open_one_does():
    made = opening("reference", HALF_OPEN)
    before = made.pose_table.detach().clone()
    made.render(rays(), MARCHING, PositionGradient()).colour.square().sum().backward()
    made.step(FieldRates(1e-2, 1e-2, (), 0.0))
    offset = made.shape.pose_grid.offset
    moved = [bool((made.pose_table - before)[int(offset[k]) : int(offset[k + 1])].any()) for k in range(6)]
    weights = level_weights(HALF_OPEN, 6)
    assert moved == [bool(w > 0) for w in weights]
    assert True in moved
    assert False in moved


def test_the_first_layers_gradient_is_the_one_through_the_mixing():
    made = opening("reference", HALF_OPEN)
    learnt = made.state()["network0"].clone().requires_grad_()
    mixing = torch.tensor(np.kron(level_mixing(HALF_OPEN, 6), np.eye(2)), dtype=torch.float32)
    before = learnt.detach().clone()
    made.networks[0].data.copy_((before @ mixing).data)
    made.render(rays(), MARCHING, PositionGradient()).colour.square().sum().backward()
    through = made.networks[0].grad.clone()
    (learnt @ mixing).backward(through)
    made.step(FieldRates(0.0, 1e-3, (), 0.0))
    step = made.state()["network0"] - before
    expected = -1e-3 * learnt.grad.sign()
    agree = (step - expected).abs() < 1e-6
    assert float(agree.float().mean()) > 0.99


def test_a_restored_field_goes_on_with_the_learnt_layer_not_the_mixed_one():
    def step(made: GridField) -> None:
        made.reach(0.3)
        made.render(rays(), MARCHING, PositionGradient()).colour.square().sum().backward()
        made.step(FieldRates(1e-2, 1e-2, (), 0.0))

    first = opening("cpu", 0.2)
    step(first)
    saved = {name: tensor.clone() for name, tensor in first.state().items()}
    step(first)
    second = opening("cpu", 0.0)
    second.load_state(saved)
    step(second)
    for name, tensor in first.state().items():
        assert torch.equal(second.state()[name], tensor), name
