"""BARF's network against a second writing of it, its encodings against their formulas, and its gradients."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from biresnerf.field.radiance_field import FieldRates, Marching, PositionGradient, Rays
from biresnerf.studies.baselines.mlp_field import LAYERS, SKIP, MlpField, positional_encoding

CPU = torch.device("cpu")
HIDDEN, LENGTH = 12, 0.8


def field(*, stratified: int | None = None, unbounded: bool = False, progress: float = 0.4) -> MlpField:
    made = MlpField(7, CPU, hidden=HIDDEN, unbounded=unbounded, length=LENGTH, stratified=stratified)
    with torch.no_grad():
        for bias in made.parameters[1::2]:  # zero at the start: a fault in them would not show
            bias.uniform_(-0.3, 0.3, generator=torch.Generator().manual_seed(1))
    made.reach(progress)
    return made


def rays(count: int = 5, trained: int | None = None, samples: int | None = None) -> Rays:
    generator = torch.Generator().manual_seed(3)
    direction = torch.nn.functional.normalize(torch.randn(count, 3, generator=generator), dim=1)
    origin = 0.3 * (torch.rand(count, 3, generator=generator) - 0.5) - 3 * direction
    shape = (count,) if samples is None else (count, samples)
    return Rays(
        origin.requires_grad_(),
        direction.requires_grad_(),
        torch.rand(count, 3, generator=generator),
        torch.rand(shape, generator=generator),
        count if trained is None else trained,
    )


def marching(near: float = 1.5, far: float = 4.5, occupied: float = 1.0) -> Marching:
    cells = torch.rand(8, 8, 8, generator=torch.Generator().manual_seed(2)) < occupied
    return Marching(0.05, near, far, 256, cells.to(torch.uint8))


def window(progress: float, bands: int) -> list[float]:
    """BARF's weights, written out band by band."""
    alpha = bands * (progress - 0.1) / 0.4
    weights = []
    for k in range(bands):
        if alpha < k:
            weights.append(0.0)
        elif alpha - k < 1:
            weights.append((1 - math.cos(math.pi * (alpha - k))) / 2)
        else:
            weights.append(1.0)
    return weights


@pytest.mark.parametrize("progress", [0.0, 0.1, 0.17, 0.3, 0.499, 0.5, 1.0])
@pytest.mark.parametrize("bands", [10, 4])
def test_the_encoding_is_sines_and_cosines_of_doubling_frequencies_in_barfs_window(progress, bands):
    x = torch.randn(6, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    expected = [[*point] for point in x.tolist()]
    for row, point in zip(expected, x.tolist(), strict=True):
        for value in point:
            for wave in (math.sin, math.cos):
                row += [w * wave(2**k * math.pi * value) for k, w in enumerate(window(progress, bands))]
    torch.testing.assert_close(positional_encoding(x, bands, progress), torch.tensor(expected).double())


def test_the_network_is_barfs_written_with_torch_modules():
    made = field()
    encoded = 63
    sizes = [(encoded, HIDDEN)] + [(HIDDEN + encoded * (i == SKIP), HIDDEN) for i in range(1, LAYERS - 1)]
    sizes += [(HIDDEN, HIDDEN + 1), (HIDDEN + 27, HIDDEN // 2), (HIDDEN // 2, 3)]
    layers = [torch.nn.Linear(*size) for size in sizes]
    with torch.no_grad():
        for i, layer in enumerate(layers):
            layer.weight.copy_(made.parameters[2 * i])
            layer.bias.copy_(made.parameters[2 * i + 1])
    generator = torch.Generator().manual_seed(4)
    x = torch.rand(9, 3, generator=generator) * 2 - 1
    view = torch.nn.functional.normalize(torch.randn(9, 3, generator=generator), dim=1)
    points = positional_encoding(x / LENGTH, 10, 0.4)
    h = points
    for i, layer in enumerate(layers[:LAYERS]):
        if i == SKIP:
            h = torch.cat([h, points], 1)
        h = layer(h) if i == LAYERS - 1 else torch.relu(layer(h))
    logit, h = h[:, 0], torch.relu(h[:, 1:])
    h = torch.relu(layers[LAYERS](torch.cat([h, positional_encoding(view, 4, 0.4)], 1)))
    density, colour = made.network(x, view, made.parameters)
    torch.testing.assert_close(density * LENGTH, torch.log1p(torch.exp(logit)))
    torch.testing.assert_close(colour, torch.sigmoid(layers[LAYERS + 1](h)))


@pytest.mark.parametrize(("stratified", "unbounded"), [(16, False), (16, True), (None, False), (None, True)])
def test_gradients_to_origins_and_directions_are_those_of_finite_differences(stratified, unbounded):
    made = field(stratified=stratified, unbounded=unbounded, progress=0.25)
    made.parameters = [p.detach().double().requires_grad_() for p in made.parameters]
    given = rays(4, samples=stratified)
    weight = torch.rand(4, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(5))
    # Bounds of the march that do not move with the ray, so that samples stay on it.
    where = marching(0.5, 60.0) if stratified and unbounded else marching(2.2, 3.6)

    def value(origin: torch.Tensor, direction: torch.Tensor) -> torch.Tensor:
        moved = Rays(origin, direction, given.background.double(), given.jitter.double(), 4)
        return (made.render(moved, where, PositionGradient()).colour * weight).sum()

    start = [given.origin.detach().double(), given.direction.detach().double()]
    variables = [tensor.clone().requires_grad_() for tensor in start]
    gradients = torch.autograd.grad(value(*variables), variables)
    generator = torch.Generator().manual_seed(6)
    for which in (0, 1):
        step = torch.randn(4, 3, dtype=torch.float64, generator=generator)
        h = 1e-7  # so small that hardly a rectifier switches within it
        ahead, behind = [list(start) for _ in range(2)]
        ahead[which], behind[which] = start[which] + h * step, start[which] - h * step
        with torch.no_grad():
            difference = float(value(*ahead) - value(*behind)) / (2 * h)
        assert float((gradients[which] * step).sum()) == pytest.approx(difference, rel=1e-4, abs=1e-6)


def test_a_stratified_ray_has_one_sample_in_each_bin_and_ends_at_the_last():
    made = field(stratified=8)
    given = rays(3, samples=8)
    seen = []
    network = made.network
    made.network = lambda x, view, parameters: (seen.append(x), network(x, view, parameters))[1]
    with torch.no_grad():
        result = made.render(given, marching(1.0, 5.0), PositionGradient())
    t = ((seen[0].reshape(3, 8, 3) - given.origin[:, None]) @ given.direction[:, :, None])[..., 0]
    assert ((t - 1.0) / 0.5).floor().tolist() == [list(range(8))] * 3
    torch.testing.assert_close((t - 1.0) / 0.5 % 1.0, given.jitter, atol=1e-4, rtol=0)
    torch.testing.assert_close(result.opacity, torch.ones(3))  # nothing is left for a background
    assert result.samples == 24


def test_inverse_depth_puts_as_many_samples_in_front_as_the_far_half_has():
    made = field(stratified=64, unbounded=True)
    given = rays(1, samples=64)
    seen = []
    made.network = lambda x, _view, _p: (seen.append(x), (x[:, 0].abs(), x.sigmoid()))[1]
    made._contracted = lambda x: x
    with torch.no_grad():
        made.render(given, marching(0.5, 60.0), PositionGradient())
    t = ((seen[0] - given.origin) * given.direction).sum(1)
    assert float(t.detach().min()) >= 0.5
    assert float(t.max()) <= 60.0
    assert int((t < 2 / (1 / 0.5 + 1 / 60.0)).sum()) == 32  # half of the inverse range


def test_only_occupied_cells_are_marched_and_the_background_shows_behind_them():
    made = field()
    given = rays(6)
    with torch.no_grad():
        empty = made.render(given, marching(occupied=0.0), PositionGradient())
        half = made.render(given, marching(occupied=0.5), PositionGradient())
        full = made.render(given, marching(), PositionGradient())
    torch.testing.assert_close(empty.colour, given.background)
    assert empty.samples == 0
    assert 0.3 * full.samples < half.samples < 0.7 * full.samples
    assert float(full.opacity.max()) < 1.0


@pytest.mark.parametrize("stratified", [8, None])
def test_only_trained_rays_give_gradients_to_the_network_and_all_to_their_poses(stratified):
    made = field(stratified=stratified)
    given = rays(6, trained=0, samples=stratified)
    made.render(given, marching(), PositionGradient()).colour.sum().backward()
    assert all(parameter.grad is None or not parameter.grad.any() for parameter in made.parameters)
    assert (given.origin.grad.abs().sum(1) > 0).all()
    made.discard_gradients()
    part, alone = rays(6, trained=2, samples=stratified), rays(6, samples=stratified)
    made.render(part, marching(), PositionGradient()).colour.sum().backward()
    mixed = [parameter.grad.clone() for parameter in made.parameters]
    made.discard_gradients()
    first = Rays(alone.origin[:2], alone.direction[:2], alone.background[:2], alone.jitter[:2], trained=2)
    made.render(first, marching(), PositionGradient()).colour.sum().backward()
    for a, parameter in zip(mixed, made.parameters, strict=True):
        torch.testing.assert_close(a, parameter.grad, rtol=1e-4, atol=1e-6)


def test_the_density_for_the_occupancy_grid_is_the_networks():
    for unbounded in (False, True):
        made = field(unbounded=unbounded)
        position = torch.rand(50, 3, generator=torch.Generator().manual_seed(8))
        x = position * 4 - 2 if unbounded else position * 2 - 1
        expected = made.network(x, torch.ones(50, 3), made.parameters)[0]
        torch.testing.assert_close(made.density(position), expected.detach())


def test_a_field_without_a_second_stage_refuses_to_begin_one():
    with pytest.raises(RuntimeError, match="second stage"):
        field().start_reconstruction()


def test_steps_follow_adam_and_a_restored_state_goes_on_alike():
    def step(made: MlpField) -> None:
        made.render(rays(4), marching(), PositionGradient()).colour.square().sum().backward()
        made.step(FieldRates(0.0, 1e-3, (), 0.0))

    first = field()
    step(first)
    saved = {name: tensor.clone() for name, tensor in first.state().items()}
    step(first)
    second = field()
    second.load_state(saved)
    step(second)
    for a, b in zip(first.parameters, second.parameters, strict=True):
        assert torch.equal(a, b)
    moved = np.concatenate(
        [(a - saved[f"parameter{i}"]).detach().abs().ravel() for i, a in enumerate(first.parameters)]
    )
    assert 0 < moved.max() <= 1.5e-3  # Adam's step has the size of the rate
