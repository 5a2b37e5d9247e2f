"""Kernel launches bound to fixed buffers: run one by one, or recorded once as a CUDA graph and replayed.

Whatever changes from step to step (counts, intervals, rates) lies in device memory, never in a launch's arguments, so
running the same launches again is always right.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import torch
import triton

from biresnerf.errors import InputError
from biresnerf.field.cuda.rays import march


def interpreted() -> bool:
    """Whether Triton's interpreter runs the kernels: TRITON_INTERPRET was set when they were loaded (tests only)."""
    return not isinstance(march, triton.JITFunction)


def refuse_the_wrong_mode(device: torch.device) -> None:
    """Raise `InputError` if the interpreter, meant for tests without CUDA, is on for a GPU or off without one."""
    if interpreted() == (device.type == "cuda"):
        raise InputError(
            "device_unavailable",
            f"Triton's interpreter is {'on' if interpreted() else 'off'}: the kernels cannot run on {device}.",
            where="device",
            hint="Unset TRITON_INTERPRET, and use --device cpu where there is no CUDA.",
        )


def block(size: int) -> int:
    """Items a program takes: `size`, or many more in the interpreter, whose cost is per program."""
    return max(size, 512) if interpreted() else size


@dataclass(frozen=True)
class Launch:
    """One kernel with its grid and all its arguments, by name."""

    kernel: Any
    grid: tuple[int, ...]
    arguments: dict[str, Any]
    warps: int

    def __call__(self) -> None:
        self.kernel[self.grid](**self.arguments, num_warps=self.warps, num_stages=1)


def bind(
    kernel: Any, grid: tuple[int, ...], buffers: Mapping[str, Any], *, warps: int = 4, **others: Any
) -> Launch:
    """A launch whose arguments are `others`, else the buffers named as the kernel's parameters."""
    names = inspect.signature(kernel.fn).parameters
    return Launch(kernel, grid, {n: others[n] if n in others else buffers[n] for n in names}, warps)


class Plan:
    """A fixed sequence of launches, and of torch operations that write into given tensors."""

    def __init__(self, launches: list[Callable[[], Any]], device: torch.device) -> None:
        self.launches, self.device = launches, device
        self._graph: torch.cuda.CUDAGraph | None = None
        self._ran = False

    def run(self) -> None:
        if self._graph is not None:
            self._graph.replay()
            return
        for launch in self.launches:
            launch()
        self._ran = True

    def record(self) -> None:
        """Make a CUDA graph of it once it has run, which has compiled its kernels. Recording executes nothing."""
        if self.device.type != "cuda" or self._graph is not None or not self._ran:
            return
        graph = torch.cuda.CUDAGraph()
        with torch.cuda.graph(graph, capture_error_mode="thread_local"):
            for launch in self.launches:
                launch()
        self._graph = graph
