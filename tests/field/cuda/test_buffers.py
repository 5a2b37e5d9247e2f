"""Memory of the CUDA kernels: a buffer's old content does not matter, and nothing is written outside of it."""

from __future__ import annotations

from types import SimpleNamespace

import pytest
import torch

pytest.importorskip(
    "triton",
    minversion="3.2",
    reason="the CUDA backend's kernels need Triton, for Linux only; its interpreter runs them from 3.2 on",
)

from biresnerf.field.cuda import workspace
from biresnerf.field.cuda.check_batch import learn
from biresnerf.field.radiance_field import FieldRates, Merging, PositionGradient
from tests.field.cuda.fields import DEVICE, HAS_GPU, RATES, make_fast, make_marching, make_rays

pytestmark = pytest.mark.slow

FIRST, SECOND = (33, 20) if HAS_GPU else (8, 5)  # rays of the steps; the interpreter takes its time for each
# On a GPU additions to tables come in another order each time, of which Adam makes other tables: they stay as they are.
LEARNING = FieldRates(0.0, 0.0, (0.0, 0.0, 0.0), 0.0) if HAS_GPU else RATES
GUARD = 64  # values at either end of a buffer
POISON = {torch.float32: float("nan"), torch.int32: -(2**30), torch.uint8: 171}


class GuardedMemory:
    """Makes buffers in the middle of larger ones; all of it holds poison, but for what is to be zero."""

    def __init__(self) -> None:
        self.guards: list[torch.Tensor] = []

    def empty(self, shape, dtype=torch.float32, device=None):
        shape = shape if isinstance(shape, tuple) else (shape,)
        size = torch.Size(shape).numel()
        whole = torch.full((GUARD + size + GUARD,), POISON[dtype], dtype=dtype, device=device)
        self.guards += [whole[:GUARD], whole[GUARD + size :]]
        return whole[GUARD : GUARD + size].view(shape)

    def zeros(self, *shape, dtype=torch.float32, device=None):
        return self.empty(shape, dtype, device).zero_()

    def untouched(self) -> bool:
        return all(
            bool(guard.isnan().all() if guard.is_floating_point() else (guard == POISON[guard.dtype]).all())
            for guard in self.guards
        )


def two_steps(unbounded: bool, reconstructing: bool) -> list[torch.Tensor]:
    """Everything that comes of two steps, of a view and of densities: the second step takes fewer rays."""
    field = make_fast(unbounded, reconstructing)
    found = []
    for count, merging in ((FIRST, None), (SECOND, Merging(0.05, 4))):
        rays, marching = make_rays(count, count // 2, unbounded), make_marching(merging=merging)
        rendering = learn(field, rays, marching, PositionGradient(1.0, 0.5, 0.7))
        found += [rendering.colour, rendering.opacity, rendering.depth, rays.origin.grad, rays.direction.grad]
        field.step(LEARNING)
    with torch.no_grad():
        found.append(field.render(make_rays(4, 0, unbounded), make_marching(), PositionGradient()).colour)
    found.append(field.density(torch.rand(50, 3, generator=torch.Generator().manual_seed(1)).to(DEVICE)))
    tables = [field.pose_table, *([field.reconstruction_table] if reconstructing else [])]
    return [each.detach().clone() for each in (*found, *tables, *field.networks)]


@pytest.mark.parametrize(("unbounded", "reconstructing"), [(False, True), (True, True), (False, False)])
def test_results_do_not_depend_on_what_buffers_held_and_nothing_else_is_written(
    unbounded, reconstructing, monkeypatch
):
    expected = two_steps(unbounded, reconstructing)
    memory = GuardedMemory()
    names = {name: getattr(torch, name) for name in dir(torch)}
    guarded = SimpleNamespace(**{**names, "empty": memory.empty, "zeros": memory.zeros})
    monkeypatch.setattr(workspace, "torch", guarded)
    found = two_steps(unbounded, reconstructing)
    assert len(memory.guards) > 2 * 30
    assert memory.untouched()
    for one, other in zip(found, expected, strict=True):
        assert torch.isfinite(one).all()
        torch.testing.assert_close(one, other, rtol=1e-5, atol=1e-7)


def test_a_field_whose_buffers_were_freed_takes_smaller_ones_for_fewer_rays_and_renders_the_same():
    field, marching, gradient = make_fast(samples=64), make_marching(), PositionGradient(1.0, 1.0, 1.0)
    field.render(make_rays(20), marching, gradient)
    large = field._workspace.capacity.samples
    expected = field.render(make_rays(2), marching, gradient).colour.detach()
    assert field._workspace.capacity.samples == large
    field.release_memory()
    assert field._workspace is None
    found = field.render(make_rays(2), marching, gradient).colour.detach()
    assert field._workspace.capacity.samples < large
    torch.testing.assert_close(found, expected, rtol=1e-5, atol=1e-7)
