"""Our Adam takes the steps of torch's, and no process that trains loads torch's compiler."""

from __future__ import annotations

import subprocess
import sys

import pytest
import torch

from biresnerf.field.adam import Adam

BETAS, EPS = (0.8, 0.95), 1e-6


def parameters() -> list[torch.Tensor]:
    random = torch.Generator().manual_seed(0)
    return [torch.randn(*shape, generator=random).requires_grad_() for shape in ((5, 3), (4,))]


def give_gradients(moved: list[torch.Tensor], step: int) -> None:
    random = torch.Generator().manual_seed(step)
    for i, parameter in enumerate(moved):
        gradient = torch.randn(parameter.shape, generator=random)
        parameter.grad = None if i == step % 3 else gradient  # each goes without now and then


@pytest.mark.parametrize("decay", [0.0, 0.1])
def test_steps_are_those_of_torch(decay: float) -> None:
    ours, theirs = parameters(), parameters()
    adam = Adam(ours, BETAS, EPS, decay)
    reference = torch.optim.Adam(theirs, betas=BETAS, eps=EPS, weight_decay=decay, fused=True)
    for step in range(7):
        give_gradients(ours, step)
        give_gradients(theirs, step)
        adam.step(0.1 / (1 + step))
        reference.param_groups[0]["lr"] = 0.1 / (1 + step)
        reference.step()
    for one, other in zip(ours, theirs, strict=True):
        torch.testing.assert_close(one, other, rtol=0, atol=0)


def test_a_restored_state_goes_on_alike_and_a_forgotten_row_begins_anew() -> None:
    ours, copies = parameters(), parameters()
    adam = Adam(ours, BETAS, EPS)
    for step in range(3, 6):
        give_gradients(ours, step)
        adam.step(0.1)
    other = Adam(copies, BETAS, EPS)
    other.load_state("a", adam.state("a"))
    with torch.no_grad():
        for one, copied in zip(ours, copies, strict=True):
            copied.copy_(one)
    other.forget_row(2)
    for moved, optimiser in ((ours, adam), (copies, other)):
        give_gradients(moved, 8)
        optimiser.step(0.1)
    others = [0, 1, 3, 4]
    torch.testing.assert_close(ours[0][others], copies[0][others], rtol=0, atol=0)
    assert not torch.equal(ours[0][2], copies[0][2])


def test_training_does_not_load_the_compiler_of_torch() -> None:
    program = """
import sys, torch
from biresnerf.field.adam import Adam
parameter = torch.ones(3, requires_grad=True)
adam = Adam([parameter])
parameter.sum().backward()
adam.step(0.1)
print(round(float(parameter[0]), 6), "torch._dynamo" in sys.modules)
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["0.9", "False"]
