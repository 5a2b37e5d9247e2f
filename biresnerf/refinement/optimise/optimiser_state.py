"""The state of a joint optimisation, as checkpoints keep it: tensors of its parts, and a few numbers."""

from __future__ import annotations

from typing import Protocol

from torch import Tensor

from biresnerf.frozen_model import FrozenModel


class StepState(FrozenModel):
    """The numbers of an optimisation that are not tensors.

    Attributes:
        switch: the step that stage 2 began at, None before.
        rays: of the next step.
        poses_held: whether poses stand still.
        batch_share: the share of the requested samples that fits in the device's memory.
        planned_steps: steps that the lengths of the run follow from: fewer than requested where time is short.
        steps: where the run ends.
    """

    step_index: int
    switch: int | None
    rays: int
    poses_held: bool
    batch_share: float = 1.0
    planned_steps: int
    steps: int


class Part(Protocol):
    """A part of the optimisation with tensors of its own."""

    def state(self) -> dict[str, Tensor]: ...
    def load_state(self, state: dict[str, Tensor]) -> None: ...
