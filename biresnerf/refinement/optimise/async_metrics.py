"""Metrics of a step, read without making the host wait for the device."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True)
class StepResult:
    """Loss against the (blurred) targets, mean squared error of training rays against the sharp photos, and effort.

    On CUDA the first two are those of the previous step (see `AsyncMetrics`).
    """

    loss: float
    mean_squared_error: float
    rays: int
    samples: int


class AsyncMetrics:
    """On CUDA returns the previous step's metrics, copied while this step was prepared; elsewhere this step's.

    Waiting for a step's own metrics would leave the device idle while the host prepares the next step.
    """

    def __init__(self, device: torch.device) -> None:
        self._on_device = device.type == "cuda"
        self._pending: tuple[Tensor, torch.cuda.Event] | None = None

    def read(self, *metrics: Tensor) -> list[float]:
        """Values of scalar tensors, always as many and in the same order; the first call waits for its own."""
        if not self._on_device:
            return [float(metric) for metric in metrics]
        previous, self._pending = self._pending, self._send(metrics)
        values, copied = previous or self._pending
        copied.synchronize()
        return [float(value) for value in values]

    @staticmethod
    def _send(metrics: tuple[Tensor, ...]) -> tuple[Tensor, torch.cuda.Event]:
        values = torch.empty(len(metrics), pin_memory=True)
        values.copy_(torch.stack([metric.detach().float() for metric in metrics]), non_blocking=True)
        copied = torch.cuda.Event()
        copied.record()
        return values, copied
