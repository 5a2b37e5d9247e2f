"""Rays end where hardly any light is left: by the definition, and in the CPU backend's segments alike."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from biresnerf.field.cpu.field import CpuField
from biresnerf.field.cpu.samples import MOST_SEGMENTS, SEGMENT, segments
from biresnerf.field.grid_levels import grid_levels
from biresnerf.field.radiance_field import FieldShape, Marching, PositionGradient, Rays
from biresnerf.field.reference import operations as reference
from biresnerf.field.reference.field import ReferenceField

CPU = torch.device("cpu")


def test_what_less_than_a_ten_thousandth_of_the_light_reaches_takes_no_part():
    # Transmittance before the samples: 1, e^-9 = 1.2e-4, e^-10 = 4.5e-5.
    density = torch.tensor([9.0, 1.0, 5.0], requires_grad=True)
    colour = torch.rand(3, 3, requires_grad=True)
    background = torch.zeros(1, 3)
    t, dt, ray = torch.arange(3.0), torch.ones(3), torch.zeros(3, dtype=torch.long)
    rgb, opacity, _ = reference.composite(density, colour, t, dt, ray, background)
    rgb.sum().backward()
    assert float(opacity.detach()) == pytest.approx(1 - np.exp(-10), abs=1e-7)
    assert colour.grad[1].min() > 0
    assert density.grad[1] != 0
    assert colour.grad[2].abs().max() == 0
    assert density.grad[2] == 0


def dense(kind, **more):
    """A field so dense that most rays end inside the box."""
    shape = FieldShape(grid_levels(3, 8, 20, 14), grid_levels(4, 16, 60, 12), False)
    field = kind(shape, 3, CPU, **more)
    generator = torch.Generator().manual_seed(5)
    with torch.no_grad():
        for tensor in (field.pose_table, field.reconstruction_table, field.reconstruction_columns):
            tensor.copy_((torch.rand(tensor.shape, generator=generator) - 0.5) * 4)
        field.networks[1][0] *= 4
    field.start_reconstruction()
    return field


def some_rays() -> Rays:
    generator = torch.Generator().manual_seed(7)
    direction = torch.nn.functional.normalize(torch.randn(300, 3, generator=generator), dim=1)
    origin = (torch.rand(300, 3, generator=generator) - 0.5) - 2.5 * direction
    return Rays(origin.requires_grad_(), direction.requires_grad_(), torch.rand(300, 3, generator=generator),
                torch.rand(300, generator=generator), 211)  # fmt: skip


def test_the_fast_field_ends_rays_where_the_definition_does():
    marching = Marching(0.04, 0.05, 10.0, 256, torch.ones(8, 8, 8, dtype=torch.uint8))
    fast, slow = dense(CpuField, workers=2), dense(ReferenceField)
    given = some_rays()
    samples, *_ = fast.render_forward(
        given.origin.detach().numpy(), given.direction.detach().numpy(), np.zeros((300, 16), np.float32),
        given, marching, PositionGradient(),
    )  # fmt: skip
    kept = int((samples.composited.kept_end - samples.composited.kept_begin).sum())
    assert 0.1 * len(samples.t) < kept < 0.9 * len(samples.t)
    results = []
    for field in (fast, slow):
        given = some_rays()
        rendering = field.render(given, marching, PositionGradient())
        ((rendering.colour - 0.3) ** 2).mean().backward()
        results.append((rendering, given, [w.grad.clone() for w in field.networks]))
    (a, rays_a, weights_a), (b, rays_b, weights_b) = results
    torch.testing.assert_close(a.colour, b.colour, atol=1e-3, rtol=0)
    torch.testing.assert_close(a.opacity, b.opacity, atol=1e-3, rtol=0)
    off = (rays_a.origin.grad - rays_b.origin.grad).abs().amax(1) / rays_b.origin.grad.abs().max()
    assert int((off > 2e-3).sum()) <= 5  # samples on cell faces
    for wa, wb in zip(weights_a, weights_b, strict=True):
        assert float((wa - wb).abs().max()) < 5e-3 * float(wb.abs().max())


def test_segments_are_whole_rays_of_one_kind_and_all_of_them():
    for rays, trained, most in ((1000, 700, 60), (3, 0, 5), (5, 5, 900), (0, 0, 1), (4000, 4000, 300)):
        count = np.random.default_rng(rays).integers(0, most, rays)
        offset = np.concatenate([[0], np.cumsum(count)]).astype(np.int64)
        first, learning = segments(offset, trained)
        assert first[0] == 0
        assert first[-1] == rays
        assert first[learning] == trained
        assert (np.diff(first) > 0).all()
        size = max(SEGMENT, offset[-1] / MOST_SEGMENTS)
        assert np.diff(offset[first]).max(initial=0) <= size + 2 * most
