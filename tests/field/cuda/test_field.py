"""The CUDA backend against the plain-torch definition: values and every gradient.

On a GPU where there is one; elsewhere Triton's interpreter runs the kernels on the CPU, and sizes are tiny.
"""

from __future__ import annotations

import logging

import pytest
import torch

pytest.importorskip(
    "triton",
    minversion="3.2",
    reason="the CUDA backend's kernels need Triton, for Linux only; its interpreter runs them from 3.2 on",
)

from biresnerf.errors import InputError
from biresnerf.field.cuda import field as cuda_field
from biresnerf.field.cuda import plans
from biresnerf.field.cuda.check_batch import DefinedField, learn
from biresnerf.field.cuda.field import CudaField
from biresnerf.field.radiance_field import Merging, PositionGradient
from biresnerf.field.reference import operations as reference
from tests.field.cuda.fields import (
    DEVICE,
    HAS_GPU,
    RATES,
    SHAPES,
    TOLERANCE,
    close,
    close_but_for_cell_faces,
    make,
    make_fast,
    make_marching,
    make_rays,
)

pytestmark = pytest.mark.slow

needs_gpu = pytest.mark.skipif(not HAS_GPU, reason="CUDA graphs and late counts need a GPU; torch finds none")


MERGING = Merging(light=0.05, most=4)
MANY = 33 if HAS_GPU else 10  # rays; more than a program takes, but for the interpreter, which pays for each


@pytest.mark.parametrize(
    ("unbounded", "reconstructing", "count", "trained", "merging"),
    [
        (False, True, MANY, MANY - 4, None),
        (True, True, MANY, MANY, MERGING),
        (False, True, MANY + 2, 8, MERGING),
        (False, False, 5, 5, MERGING),
        (True, False, 9, 0, None),
    ],
)
def test_values_and_all_gradients_equal_the_reference(unbounded, reconstructing, count, trained, merging):
    gradient = PositionGradient(1.0, 0.5, 0.7)
    fields = make(DefinedField, unbounded, reconstructing), make_fast(unbounded, reconstructing)
    results = []
    for field in fields:
        rays = make_rays(count, trained, unbounded)
        rendering = learn(field, rays, make_marching(merging=merging), gradient)
        weights = [*field.networks, *([field.reconstruction_columns] if reconstructing else [])]
        results.append((rendering, rays, [None if w.grad is None else w.grad.clone() for w in weights]))
    (a, rays_a, weights_a), (b, rays_b, weights_b) = results
    assert b.samples == pytest.approx(a.samples, abs=2)  # a midpoint on a cell face may fall to either side
    assert b.samples > 3 * count
    close(b.colour, a.colour)
    close(b.opacity, a.opacity)
    close(b.depth, a.depth)
    close_but_for_cell_faces(rays_b.origin.grad, rays_a.origin.grad)
    close_but_for_cell_faces(rays_b.direction.grad, rays_a.direction.grad)
    if not trained:
        assert all(w is None for w in weights_b)
        return
    for wa, wb in zip(weights_a, weights_b, strict=True):
        close(wb, wa)
    slow, fast = fields
    for field in fields:
        field.step(RATES)
        learn(field, make_rays(count, trained, unbounded), make_marching(merging=merging), gradient)
        field.step(RATES)  # with moments from the first step
    for name in ("pose", "reconstruction") if reconstructing else ("pose",):
        expected, table = (getattr(field, f"{name}_table").detach() for field in fields)
        for at in (0, 1):
            close(fast.moments[name][at], slow.moments[name][at], 5 * TOLERANCE)
        clear = slow.moments[name][0].abs() > 0.03 * slow.moments[name][0].abs().max()
        close(table[clear], expected[clear], 0.05)
    for wa, wb in zip(slow.networks, fast.networks, strict=True):
        assert float((wa - wb).detach().abs().mean()) < 1e-3


def test_a_level_with_rate_zero_is_left_alone_and_its_gradient_forgotten():
    field = make_fast()
    before = field.reconstruction_table.clone()
    learn(field, make_rays(7), make_marching(), PositionGradient())
    field.step(RATES)
    offset = field.shape.reconstruction_grid.offset
    moved = [(field.reconstruction_table != before)[offset[i] : offset[i + 1]].any() for i in range(3)]
    assert [bool(m) for m in moved] == [True, True, False]
    assert field._workspace is not None
    for table in field._workspace.tables.values():
        assert not table["gradient"].any()


def test_a_step_whose_samples_were_overwritten_is_refused():
    field = make_fast()
    learn(field, make_rays(5), make_marching(), PositionGradient(1.0, 1.0, 1.0))
    field.density(torch.rand(10, 3, device=DEVICE))
    with pytest.raises(RuntimeError, match="between backward and step"):
        field.step(RATES)


@pytest.mark.parametrize("unbounded", [False, True])
def test_marching_finds_the_live_intervals_of_the_reference(unbounded):
    field = make_fast(unbounded, samples=40 * 128)  # so that all rays are marched at once
    rays, marching = make_rays(40, unbounded=unbounded), make_marching(0.05)
    t, dt, ray = reference.march(
        rays.origin.detach(), rays.direction.detach(), rays.jitter, marching.occupied, marching.step,
        marching.near, marching.far, unbounded, marching.most,
    )  # fmt: skip
    with torch.no_grad():
        samples = field.render(rays, marching, PositionGradient()).samples
    buffers = field._workspace.buffers
    assert int(buffers["taken"]) == samples
    # Where a midpoint lies on the face of a cell, rounding may put it on either side: that ray is not compared.
    expected = torch.bincount(ray, minlength=40)
    found = torch.bincount(buffers["ray"][:samples].long(), minlength=40)
    same = expected == found
    assert int(same.sum()) >= 38
    of, to = same[buffers["ray"][:samples].long()], same[ray]
    assert torch.equal(buffers["ray"][:samples][of].long(), ray[to])
    t, dt, ray = t[to], dt[to], ray[to]
    torch.testing.assert_close(buffers["t"][:samples][of], t, rtol=1e-3, atol=1e-4)
    torch.testing.assert_close(buffers["dt"][:samples][of], dt, rtol=1e-2, atol=1e-4)
    point = rays.origin.detach()[ray] + t[:, None] * rays.direction.detach()[ray]
    torch.testing.assert_close(
        buffers["x"][:, :samples].T[of], reference.grid_position(point, unbounded), rtol=0, atol=1e-4
    )


def test_the_same_launches_serve_other_rays_and_settings():
    """What a graph replays: nothing that changes from step to step may be bound into a launch."""
    fast, slow = make_fast(), make(DefinedField)
    steps = [
        (MANY, MANY - 4, make_marching(0.12), PositionGradient(1.0, 1.0, 0.0)),
        (7, 7, make_marching(0.08, share=0.7, far=2.5), PositionGradient(0.0, 0.3, 1.0)),
    ]
    plans_before = None
    for seed, (count, trained, marching, gradient) in enumerate(steps):
        a, b = (make_rays(count, trained, seed=seed) for _ in range(2))
        expected, rendering = learn(slow, a, marching, gradient), learn(fast, b, marching, gradient)
        close(rendering.colour, expected.colour)
        close(rendering.depth, expected.depth)
        close_but_for_cell_faces(b.origin.grad, a.origin.grad)
        close_but_for_cell_faces(b.direction.grad, a.direction.grad)
        for wa, wb in zip(slow.networks, fast.networks, strict=True):
            close(wb.grad, wa.grad)
        for field in (fast, slow):
            field.discard_gradients()
        made = dict(fast._workspace._plans)
        assert plans_before is None or made == plans_before
        plans_before = made


def test_a_view_in_parts_equals_the_reference():
    fast, slow = make_fast(samples=60), make(DefinedField)
    rays, marching = make_rays(10), make_marching(0.2, share=0.9)
    with torch.no_grad():
        expected = slow.render(rays, marching, PositionGradient())
        rendering = fast.render(rays, marching, PositionGradient())
    assert expected.samples > 60  # more than fit at once
    assert rendering.samples == pytest.approx(expected.samples, abs=2)
    close(rendering.colour, expected.colour)
    close(rendering.opacity, expected.opacity)
    close(rendering.depth, expected.depth)


def test_rays_that_do_not_fit_are_left_out_whole_and_the_next_step_has_room(caplog, monkeypatch):
    field, marching = make_fast(samples=300), make_marching()
    monkeypatch.setattr(cuda_field.SampleCount, "expected", lambda self, rays, interval: 100)
    rays = make_rays(30)
    rendering = learn(field, rays, marching, PositionGradient())
    total, taken = int(field._workspace.buffers["ray_offset"][-1]), int(field._workspace.buffers["taken"])
    assert 0 < taken <= 300 < total
    whole = int((field._workspace.buffers["ray_offset"] <= 300).sum()) - 1
    assert int((rendering.opacity > 0).sum()) <= whole < 30
    torch.testing.assert_close(rendering.colour[whole:30], rays.background[whole:30])
    assert not rays.origin.grad[whole:30].any()
    assert rays.origin.grad[:whole].any()
    monkeypatch.undo()
    field.step(RATES)
    with caplog.at_level(logging.WARNING):
        learn(field, make_rays(30), marching, PositionGradient())
    assert "left out" in caplog.text
    assert field._workspace.capacity.samples >= total
    assert int(field._workspace.buffers["taken"]) == total


def test_no_rays_and_no_live_samples_give_background_and_zero_gradient():
    field = make_fast()
    for rays, marching in ((make_rays(0), make_marching()), (make_rays(6), make_marching(share=0.0))):
        rendering = field.render(rays, marching, PositionGradient())
        rendering.colour.sum().backward()
        assert rendering.samples == 0
        torch.testing.assert_close(rendering.colour, rays.background)
        assert not rays.origin.grad.any()
        field.step(RATES)


def test_density_and_its_estimate_equal_the_reference_also_in_parts():
    fast, slow = make_fast(True, samples=128), make(DefinedField, True)
    x = torch.rand(300, 3, generator=torch.Generator().manual_seed(2)).to(DEVICE)
    torch.testing.assert_close(fast.density(x), slow.density(x), rtol=TOLERANCE, atol=1e-4)
    torch.testing.assert_close(fast.estimate(x), slow.estimate(x), rtol=TOLERANCE, atol=1e-4)
    first = fast.estimate(x, torch.full((1,), 200, device=DEVICE))[:200]
    torch.testing.assert_close(first, slow.estimate(x)[:200], rtol=TOLERANCE, atol=1e-4)
    assert not torch.allclose(slow.estimate(x), slow.density(x))


def test_a_backward_after_another_call_is_refused():
    field = make_fast()
    rendering = field.render(make_rays(3), make_marching(), PositionGradient())
    field.density(torch.rand(4, 3, device=DEVICE))
    with pytest.raises(RuntimeError, match="between render and backward"):
        rendering.colour.sum().backward()


def test_state_restores_the_next_step():
    marching = make_marching()

    def step(field):
        learn(field, make_rays(11), marching, PositionGradient())
        field.step(RATES)

    field, other = make_fast(), make_fast(reconstructing=False)
    step(field)
    saved = {name: tensor.clone() for name, tensor in field.state().items()}
    step(field)
    other.load_state(saved)
    step(other)
    for name, tensor in field.state().items():
        # Atomic additions come in another order every time.
        torch.testing.assert_close(other.state()[name], tensor, rtol=1e-3, atol=1e-5)


def test_kernels_for_the_other_kind_of_device_are_refused():
    with pytest.raises(InputError, match="interpreter"):
        CudaField(SHAPES[False], 0, torch.device("cpu" if HAS_GPU else "cuda"))


@needs_gpu
def test_a_replayed_graph_equals_its_launches():
    launched, replayed = make_fast(), make_fast()
    for seed in range(4):
        a, b = make_rays(50, 30, seed=seed), make_rays(50, 30, seed=seed)
        if launched._workspace is not None:
            launched._workspace.record = lambda: None
        expected = learn(launched, a, make_marching(), PositionGradient(1.0, 1.0, 1.0))
        rendering = learn(replayed, b, make_marching(), PositionGradient(1.0, 1.0, 1.0))
        close(rendering.colour, expected.colour)
        close(b.origin.grad, a.origin.grad, 0.05)
        for field in (launched, replayed):
            field.step(RATES)
    assert replayed._workspace.plan(plans.forward, False)._graph is not None
    assert launched._workspace.plan(plans.forward, False)._graph is None


@needs_gpu
def test_a_step_never_waits_for_the_device():
    field, marching, rays = make_fast(), make_marching(), make_rays(50)
    for _ in range(3):
        learn(field, rays, marching, PositionGradient())
        field.step(RATES)
    torch.cuda.set_sync_debug_mode("error")
    try:
        learn(field, rays, marching, PositionGradient())
        field.step(RATES)
    finally:
        torch.cuda.set_sync_debug_mode("default")
