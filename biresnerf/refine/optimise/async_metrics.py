"""Figures of a step, read without making the host wait for the device."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True)
class StepResult:
    """Loss against the (blurred) targets, mean squared error of training rays against the sharp photos, and effort.

    On CUDA the first two are those of the step before (see `LateFigures`).
    """

    loss: float
    mean_squared_error: float
    rays: int
    samples: int


class LateFigures:
    """On CUDA the figures of the step before, which have arrived while this one was prepared; elsewhere the step's.

    Waiting for a step's own figures would let the device run dry while the host prepares the next step.
    """

    def __init__(self, device: torch.device) -> None:
        self._on_device = device.type == "cuda"
        self._arriving: tuple[Tensor, torch.cuda.Event] | None = None

    def read(self, *figures: Tensor) -> list[float]:
        """Values of scalar tensors, always as many and in the same order; the first call waits for its own."""
        if not self._on_device:
            return [float(figure) for figure in figures]
        before, self._arriving = self._arriving, self._send(figures)
        values, arrived = before or self._arriving
        arrived.synchronize()
        return [float(value) for value in values]

    @staticmethod
    def _send(figures: tuple[Tensor, ...]) -> tuple[Tensor, torch.cuda.Event]:
        values = torch.empty(len(figures), pin_memory=True)
        values.copy_(torch.stack([figure.detach().float() for figure in figures]), non_blocking=True)
        arrived = torch.cuda.Event()
        arrived.record()
        return values, arrived
