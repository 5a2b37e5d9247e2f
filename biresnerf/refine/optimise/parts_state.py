"""The tensors of an optimisation's parts as one flat dictionary, for checkpoints and rollbacks."""

from __future__ import annotations

from typing import Protocol

from torch import Tensor


class Part(Protocol):
    """What keeps tensors from step to step."""

    def state(self) -> dict[str, Tensor]: ...
    def load_state(self, state: dict[str, Tensor]) -> None: ...


def state_of(parts: dict[str, Part]) -> dict[str, Tensor]:
    """All tensors (shared, not copied) under keys ``{part}.{name}``."""
    return {f"{name}.{key}": tensor for name, part in parts.items() for key, tensor in part.state().items()}


def load_state_of(parts: dict[str, Part], tensors: dict[str, Tensor]) -> None:
    """Restore what `state_of` gave; other keys are left alone."""
    for name, part in parts.items():
        head = f"{name}."
        part.load_state({k.removeprefix(head): v for k, v in tensors.items() if k.startswith(head)})
