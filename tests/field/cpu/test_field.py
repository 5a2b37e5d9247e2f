"""The CPU backend against the plain-torch definition: values and every gradient."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from biresnerf.field.cpu.field import CpuField
from biresnerf.field.grid_field import BETA1
from biresnerf.field.grid_levels import grid_levels
from biresnerf.field.radiance_field import (
    FieldRates,
    FieldShape,
    Marching,
    Merging,
    PositionGradient,
    Rays,
)
from biresnerf.field.reference.field import ReferenceField

CPU = torch.device("cpu")
KINK = 2e-6  # pre-activations are about 0.1; what lies nearer to zero may be rounded to either side


def _pair(unbounded: bool, reconstructing: bool):
    shape = FieldShape(grid_levels(3, 8, 20, 14), grid_levels(5, 16, 90, 12), unbounded)
    fields = ReferenceField(shape, 3, CPU), CpuField(shape, 3, CPU, workers=2)
    generator = torch.Generator().manual_seed(5)
    for field in fields:
        generator.manual_seed(5)
        with torch.no_grad():
            for table in (field.pose_table, field.reconstruction_table):
                table.copy_(torch.rand(table.shape, generator=generator) - 0.5)
            columns = field.reconstruction_columns
            columns.copy_((torch.rand(columns.shape, generator=generator) - 0.5) * 0.5)
        if reconstructing:
            field.start_reconstruction()
    return fields


def _rays(count: int, trained: int, unbounded: bool, moving: bool = True):
    generator = torch.Generator().manual_seed(7)
    direction = torch.nn.functional.normalize(torch.randn(count, 3, generator=generator), dim=1)
    aim = (torch.rand(count, 3, generator=generator) - 0.5) * 0.8
    origin = aim - direction * (1.7 if unbounded else 2.6)
    return Rays(
        origin.requires_grad_(moving),
        direction.requires_grad_(moving),
        torch.rand(count, 3, generator=generator),
        torch.rand(count, generator=generator),
        trained,
    )


def _marching(seed=1, merging=None):
    occupied = (torch.rand(16, 16, 16, generator=torch.Generator().manual_seed(seed)) < 0.4).to(torch.uint8)
    return Marching(step=0.05, near=0.1, far=12.0, most=256, occupied=occupied, merging=merging)


def _close(a, b, tolerance=2e-3, either=0.0):
    """Equal to b within a share of its largest value, and by what is right `either` way."""
    a, b = a.detach(), b.detach()
    scale = b.abs().max().clamp(min=1e-8)
    assert bool(((a - b).abs() < tolerance * scale + either).all())


class _RectifiedAbove(torch.autograd.Function):
    """A rectifier whose gradient begins a little beside zero: what rounding may make of the true one."""

    @staticmethod
    def forward(context, x, border):
        context.save_for_backward(x > border)
        return x.clamp(min=0)

    @staticmethod
    def backward(context, gradient):
        return gradient * context.saved_tensors[0], None


def _rendered(field, rays, merging):
    """The rendering of rays, after a loss on it gave gradients to all that it depends on."""
    rendering = field.render(rays, _marching(merging=merging), PositionGradient(1.0, 0.5, 0.7))
    target = torch.linspace(0, 1, len(rays.jitter) * 3).reshape(-1, 3)
    loss = ((rendering.colour - target) ** 2).mean() + 0.1 * (rendering.opacity**2).mean()
    loss.backward()
    return rendering


def _network_gradients(field):
    return [None if w.grad is None else w.grad.clone() for w in field.networks]


def _reference_gradients(field):
    tables = [field.pose_table] + [field.reconstruction_table] * field.reconstructing
    return [*_network_gradients(field), *(table.grad.clone() for table in tables)]


def _right_either_way(unbounded, reconstructing, rays, merging):
    """By how much the reference's gradients differ where the rectifiers' kinks lie a little beside zero.

    Of the networks, then of the tables.
    """
    found = []
    for border in (0.0, -KINK, KINK):
        field = _pair(unbounded, reconstructing)[0]
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(torch, "relu", lambda x, border=border: _RectifiedAbove.apply(x, border))
            _rendered(field, rays, merging)
        found.append(_reference_gradients(field))
    either = [(lower - at).abs() + (upper - at).abs() for at, lower, upper in zip(*found, strict=True)]
    return either[:5], either[5:]


def _close_but_for_cell_faces(a, b):
    """The gradient to positions jumps where a sample lies on a face: rounding may put it on either side."""
    off = (a - b).abs().amax(1) / b.abs().max() > 1e-3
    assert int(off.sum()) <= max(1, len(a) // 60)


@pytest.mark.parametrize("merging", [None, Merging(0.05, 4)])
@pytest.mark.parametrize("unbounded", [False, True])
@pytest.mark.parametrize("reconstructing", [False, True])
@pytest.mark.parametrize(
    ("count", "trained", "moving"), [(257, 257, True), (257, 257, False), (130, 77, True), (5, 0, True)]
)
def test_fast_field_equals_reference_in_values_and_all_gradients(
    unbounded, reconstructing, count, trained, moving, merging
):
    slow, fast = _pair(unbounded, reconstructing)
    rays_a, rays_b = (_rays(count, trained, unbounded, moving) for _ in range(2))
    a, b = _rendered(slow, rays_a, merging), _rendered(fast, rays_b, merging)
    weights_a, weights_b = _network_gradients(slow), _network_gradients(fast)
    assert a.samples == pytest.approx(b.samples, abs=2)  # a midpoint on a cell face may fall to either side
    assert b.samples > 5 * count
    _close(b.colour, a.colour)
    _close(b.opacity, a.opacity)
    _close(b.depth, a.depth)
    if moving:
        _close_but_for_cell_faces(rays_b.origin.grad, rays_a.origin.grad)
        _close_but_for_cell_faces(rays_b.direction.grad, rays_a.direction.grad)
    if trained:
        rays = _rays(count, trained, unbounded, moving)
        of_weights, of_tables = _right_either_way(unbounded, reconstructing, rays, merging)
        for wa, wb, apart in zip(weights_a, weights_b, of_weights, strict=True):
            _close(wb, wa, 5e-4, apart)
        rates = FieldRates(0.01, 0.005, (0.01, 0.02, 0.0, 0.01, 0.01), 0.003)
        before = slow.pose_table.detach().clone()
        slow.step(rates)
        fast.step(rates)
        moved = (slow.pose_table.detach() - before).abs() > 0
        assert moved.any()
        # The first Adam step has size rate * sign(g): compare where g is not lost in rounding.
        names = ("pose", "reconstruction") if reconstructing else ("pose",)
        for name, apart in zip(names, of_tables, strict=True):
            ma, mb = slow.moments[name][0], fast.moments[name][0]
            # Far samples of unbounded scenes: rounding of t grows with the interval.
            _close(mb, ma, 5e-3, (1 - BETA1) * apart)
            clear = ma.abs() > 1e-3 * ma.abs().max() + (1 - BETA1) * apart
            ta = slow.pose_table if name == "pose" else slow.reconstruction_table
            tb = fast.pose_table if name == "pose" else fast.reconstruction_table
            assert float((ta.detach() - tb)[clear].abs().max()) < 1e-5
        for wa, wb in zip(slow.networks, fast.networks, strict=True):
            assert float((wa - wb).detach().abs().mean()) < 2e-4
    else:
        assert all(w is None for w in weights_b)


def test_no_live_sample_gives_background_and_zero_gradient():
    _, fast = _pair(False, False)
    rays = _rays(9, 9, False)
    marching = Marching(0.05, 0.1, 12.0, 64, torch.zeros(8, 8, 8, dtype=torch.uint8))
    rendering = fast.render(rays, marching, PositionGradient())
    rendering.colour.sum().backward()
    assert rendering.samples == 0
    torch.testing.assert_close(rendering.colour, rays.background)
    assert float(rays.origin.grad.abs().max()) == 0.0


def test_density_and_its_estimate_equal_the_reference():
    slow, fast = _pair(True, True)
    x = torch.rand(333, 3)
    torch.testing.assert_close(fast.density(x), slow.density(x), rtol=1e-3, atol=1e-4)
    torch.testing.assert_close(fast.estimate(x), slow.estimate(x), rtol=1e-3, atol=1e-4)
    assert not torch.allclose(slow.estimate(x), slow.density(x))


def test_state_restores_the_next_step_exactly():
    gradient, marching = PositionGradient(), _marching()

    def step(field):
        rendering = field.render(_rays(200, 200, False), marching, gradient)
        (rendering.colour**2).mean().backward()
        field.step(FieldRates(0.01, 0.005, (0.01,) * 5, 0.003))

    _, field = _pair(False, True)
    step(field)
    saved = {k: v.clone() for k, v in field.state().items()}
    step(field)
    expected = {k: v.clone() for k, v in field.state().items()}
    _, other = _pair(False, False)
    other.load_state(saved)
    step(other)
    for key, value in expected.items():
        assert np.array_equal(other.state()[key].numpy(), value.numpy()), key


@pytest.mark.parametrize("unbounded", [False, True])
@pytest.mark.parametrize("wrong", [float("nan"), float("inf"), -float("inf"), 1e30, -3e38])
def test_rays_that_are_not_finite_break_nothing_and_leave_the_others_as_they_are(unbounded, wrong):
    """Kernels read tables without a check of bounds: what is out of range must not reach them."""
    generator = torch.Generator().manual_seed(9)
    bad = torch.rand(60, 6, generator=generator) < 0.3
    bad[40:] = False
    _, field = _pair(unbounded, True)
    clean = _rays(60, 60, unbounded, moving=False)
    expected = field.render(clean, _marching(), PositionGradient())
    hostile = replace(
        clean,
        origin=torch.where(bad[:, :3], wrong, clean.origin).requires_grad_(),
        direction=torch.where(bad[:, 3:], wrong, clean.direction).requires_grad_(),
    )
    found = field.render(hostile, _marching(), PositionGradient())
    _close(found.colour[40:], expected.colour[40:], 1e-5)
    found.colour.sum().backward()
    field.step(FieldRates(1e-2, 1e-2, (1e-2,) * 5, 1e-2))
    assert torch.isfinite(hostile.origin.grad[40:]).all()


@pytest.mark.parametrize("layer", [1, 4], ids=["empty", "black"])
def test_gradients_of_nearly_nothing_are_zero_and_never_too_small_for_quick_products(layer):
    """Of space with next to no density, and of colours that are next to black."""
    field = _pair(False, True)[1]
    with torch.no_grad():
        logits = field.networks[layer][: 1 if layer == 1 else 3]
        logits.copy_(-1000 * logits.abs())
    rays = _rays(130, 130, False)
    _rendered(field, rays, None)
    found = [rays.origin.grad, *_network_gradients(field), torch.from_numpy(field._pending[1])]
    for gradient in found:
        size = gradient.abs()
        assert not ((size > 0) & (size < torch.finfo(torch.float32).tiny)).any()
    assert any(bool(gradient.any()) for gradient in found) == (layer == 4)  # black has a density to learn
