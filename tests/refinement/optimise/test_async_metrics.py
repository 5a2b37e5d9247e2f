"""A step's figures: its own on the CPU, those of the step before on a GPU."""

from __future__ import annotations

import pytest
import torch

from biresnerf.refinement.optimise.async_metrics import AsyncMetrics


def test_on_the_cpu_the_figures_are_the_step_s_own():
    figures = AsyncMetrics(torch.device("cpu"))
    assert figures.read(torch.tensor(1.5), torch.tensor(2.5)) == [1.5, 2.5]
    assert figures.read(torch.tensor(3.5), torch.tensor(4.5)) == [3.5, 4.5]


@pytest.mark.skipif(not torch.cuda.is_available(), reason="late figures need a GPU; torch finds none")
def test_on_a_gpu_the_figures_are_those_of_the_step_before():
    figures = AsyncMetrics(torch.device("cuda"))
    read = [figures.read(torch.tensor(float(i), device="cuda")) for i in range(4)]
    assert read == [[0.0], [0.0], [1.0], [2.0]]
