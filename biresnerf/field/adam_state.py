"""Adam's moments as flat named tensors, for checkpoints."""

from __future__ import annotations

import torch
from torch import Tensor


def adam_state(name: str, optimiser: torch.optim.Optimizer) -> dict[str, Tensor]:
    """The optimiser's state under keys ``{name}_{parameter}_{entry}``; empty before its first step."""
    return {
        f"{name}_{i}_{key}": torch.as_tensor(value)
        for i, entry in optimiser.state_dict()["state"].items()
        for key, value in entry.items()
    }


def load_adam_state(name: str, optimiser: torch.optim.Optimizer, state: dict[str, Tensor]) -> None:
    """Restore what `adam_state` returned; parameters without an entry have taken no step."""
    saved = optimiser.state_dict()
    saved["state"] = {}
    for i in saved["param_groups"][0]["params"]:
        head = f"{name}_{i}_"
        entry = {k[len(head) :]: v.clone() for k, v in state.items() if k.startswith(head)}
        if entry:
            saved["state"][i] = entry
    optimiser.load_state_dict(saved)
