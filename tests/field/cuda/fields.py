"""Fields, rays and comparisons for the tests of the CUDA backend."""

from __future__ import annotations

from functools import partial

import torch

from biresnerf.field.cuda.check_batch import random_field, random_marching, random_rays
from biresnerf.field.cuda.field import CudaField
from biresnerf.field.grid_levels import grid_levels
from biresnerf.field.radiance_field import FieldRates, FieldShape, Marching, Rays

HAS_GPU = torch.cuda.is_available()
DEVICE = torch.device("cuda" if HAS_GPU else "cpu")
# TF32 products keep 10 bits of mantissa; the interpreter multiplies in float32.
TOLERANCE = 1e-2 if HAS_GPU else 2e-3
RATES = FieldRates(0.01, 0.005, (0.01, 0.02, 0.0), 0.003)
SHAPES = {
    unbounded: FieldShape(grid_levels(2, 8, 20, 14), grid_levels(3, 16, 60, 10), unbounded)
    for unbounded in (False, True)
}


def make(kind, unbounded: bool = False, reconstructing: bool = True, **more):
    return random_field(partial(kind, **more), SHAPES[unbounded], DEVICE, reconstructing=reconstructing)


def make_fast(unbounded: bool = False, reconstructing: bool = True, samples: int = 4096) -> CudaField:
    return make(CudaField, unbounded, reconstructing, samples=samples)


def make_rays(count: int, trained: int | None = None, unbounded: bool = False, seed: int = 7) -> Rays:
    return random_rays(count, count if trained is None else trained, DEVICE, unbounded=unbounded, seed=seed)


def make_marching(step: float = 0.1, **more) -> Marching:
    return random_marching(DEVICE, step=step, **more)


def close(a, b, tolerance=TOLERANCE):
    a, b = a.detach(), b.detach()
    assert torch.isfinite(a).all()
    assert float((a - b).abs().max()) <= tolerance * max(float(b.abs().max()), 1e-8)


def close_but_for_cell_faces(a, b, tolerance=TOLERANCE):
    """The gradient to positions jumps where a sample lies on a face: rounding may put it on either side."""
    off = (a - b).abs().amax(1) > tolerance * b.abs().max()
    assert int(off.sum()) <= max(1, len(a) // 30)
