"""A step whose numbers are all written before it, so that a graph can repeat it, is the step itself."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch

pytest.importorskip("triton", reason="the CUDA backend's kernels need Triton, which exists for Linux only")

from biresnerf.field.cuda.check_batch import learn
from biresnerf.field.radiance_field import PositionGradient
from tests.field.cuda.fields import DEVICE, RATES, make_fast, make_marching, make_rays

pytestmark = pytest.mark.slow
GRADIENT = PositionGradient(1.0, 0.5, 0.7)


def on_device(rate: float) -> torch.Tensor:
    return torch.full((), rate, device=DEVICE)


def test_a_step_in_two_shares_is_the_step():
    whole, shared = make_fast(), make_fast()
    prepared = SimpleNamespace(render=lambda rays, marching, gradient: shared.render_prepared(rays))
    rates = replace(RATES, networks=on_device(0.005), reconstruction_columns=on_device(0.003))
    for seed in range(3):
        rays, marching = (make_rays(6, 4, seed=seed) for _ in range(2)), make_marching(0.1 - 0.02 * seed)
        learn(whole, next(rays), marching, GRADIENT)
        whole.step(RATES)
        if shared.prepare(6, 4, marching, GRADIENT, RATES) is None:
            assert seed == 0  # no samples were counted yet
            learn(shared, next(rays), marching, GRADIENT)
            shared.step(RATES)
        else:
            learn(prepared, next(rays), marching, GRADIENT)
            shared.step_prepared(rates)
            shared.finish()
        for name, tensor in whole.state().items():
            # Rates are float32 on the device; on a GPU atomic additions come in another order.
            torch.testing.assert_close(shared.state()[name], tensor, rtol=1e-3, atol=1e-5)
