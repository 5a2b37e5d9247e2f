"""Fields, rays and comparisons for the tests of the CUDA backend."""

from __future__ import annotations

import torch

from biresnerf.field.cuda.field import CudaField
from biresnerf.field.grid_levels import grid_levels
from biresnerf.field.radiance_field import FieldRates, FieldShape, Marching, PositionGradient, Rays

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
    """A field with features that matter, the same for every kind."""
    field = kind(SHAPES[unbounded], 3, DEVICE, **more)
    generator = torch.Generator().manual_seed(5)
    with torch.no_grad():
        for tensor in (field.pose_table, field.reconstruction_table, field.reconstruction_columns):
            tensor.copy_(torch.rand(tensor.shape, generator=generator) - 0.5)
    if reconstructing:
        field.start_reconstruction()
    return field


def make_fast(unbounded: bool = False, reconstructing: bool = True, samples: int = 4096) -> CudaField:
    return make(CudaField, unbounded, reconstructing, samples=samples)


def make_rays(count: int, trained: int | None = None, unbounded: bool = False, seed: int = 7) -> Rays:
    generator = torch.Generator().manual_seed(seed)
    direction = torch.nn.functional.normalize(torch.randn(count, 3, generator=generator), dim=1)
    aim = (torch.rand(count, 3, generator=generator) - 0.5) * 0.8
    origin = aim - direction * (1.7 if unbounded else 2.6)
    background, jitter = torch.rand(count, 3, generator=generator), torch.rand(count, generator=generator)
    return Rays(
        origin.to(DEVICE).requires_grad_(),
        direction.to(DEVICE).requires_grad_(),
        background.to(DEVICE),
        jitter.to(DEVICE),
        count if trained is None else trained,
    )


def make_marching(step: float = 0.1, share: float = 0.4, most: int = 128, far: float = 12.0) -> Marching:
    occupied = torch.rand(8, 8, 8, generator=torch.Generator().manual_seed(1)) < share
    return Marching(step, 0.1, far, most, occupied.to(torch.uint8).to(DEVICE))


def learn(field, rays: Rays, marching: Marching, gradient: PositionGradient):
    """Render, a loss of colour and opacity, backward."""
    rendering = field.render(rays, marching, gradient)
    target = torch.linspace(0, 1, 3 * len(rays.origin), device=DEVICE).reshape(-1, 3)
    loss = ((rendering.colour - target) ** 2).mean() + 0.1 * (rendering.opacity**2).mean()
    loss.backward()
    return rendering


def close(a, b, tolerance=TOLERANCE):
    a, b = a.detach(), b.detach()
    assert torch.isfinite(a).all()
    assert float((a - b).abs().max()) <= tolerance * max(float(b.abs().max()), 1e-8)


def close_but_for_cell_faces(a, b, tolerance=TOLERANCE):
    """The gradient to positions jumps where a sample lies on a face: rounding may put it on either side."""
    off = (a - b).abs().amax(1) > tolerance * b.abs().max()
    assert int(off.sum()) <= max(1, len(a) // 30)
