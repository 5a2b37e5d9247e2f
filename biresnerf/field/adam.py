"""Adam, by torch's own kernel."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

MOMENTS = ("exp_avg", "exp_avg_sq")


class Adam:
    """Adam (Kingma and Ba 2015) on some parameters; the learning rate is given at each step.

    `torch.optim.Adam` takes the same steps, but loads torch's compiler: two seconds of every process. One kernel moves
    all parameters: a quarter of the time of separate operations on a CPU, one launch on a GPU.

    Args:
        weight_decay: L2, added to the gradient.
    """

    def __init__(
        self,
        parameters: Sequence[Tensor],
        betas: tuple[float, float] = (0.9, 0.999),
        eps: float = 1e-8,
        weight_decay: float = 0.0,
    ) -> None:
        self.parameters, self.betas, self.eps = list(parameters), betas, eps
        self.weight_decay = weight_decay
        self._of_parameter: dict[int, dict[str, Tensor]] = {}

    @torch.no_grad()
    def step(self, rate: float) -> None:
        """Move the parameters that have a gradient."""
        parameters, gradients, histories = [], [], []
        for i, parameter in enumerate(self.parameters):
            if parameter.grad is not None:
                parameters.append(parameter)
                gradients.append(parameter.grad)
                if i not in self._of_parameter:
                    self._of_parameter[i] = self._fresh(parameter)
                histories.append(self._of_parameter[i])
        if not parameters:
            return
        first, second, steps = ([history[name] for history in histories] for name in (*MOMENTS, "step"))
        torch._foreach_add_(steps, 1)
        torch._fused_adam_(
            parameters, gradients, first, second, [], steps, lr=rate, beta1=self.betas[0], beta2=self.betas[1],
            weight_decay=self.weight_decay, eps=self.eps, amsgrad=False, maximize=False,
        )  # fmt: skip

    def _fresh(self, parameter: Tensor) -> dict[str, Tensor]:
        moments = {name: torch.zeros_like(parameter) for name in MOMENTS}
        return {"step": torch.zeros((), device=parameter.device), **moments}

    def zero_grad(self) -> None:
        for parameter in self.parameters:
            parameter.grad = None

    def forget(self) -> None:
        """Reset all moments."""
        self._of_parameter.clear()

    def forget_row(self, row: int) -> None:
        """Reset the moments of one row of every parameter."""
        for history in self._of_parameter.values():
            for name in MOMENTS:
                history[name][row] = 0

    def state(self, name: str) -> dict[str, Tensor]:
        """Moments and steps under keys ``{name}_{parameter}_{entry}``; empty before the first step."""
        return {f"{name}_{i}_{k}": v for i, history in self._of_parameter.items() for k, v in history.items()}

    def load_state(self, name: str, state: dict[str, Tensor]) -> None:
        """Restore what `state` returned; parameters without an entry have taken no step."""
        self._of_parameter = {}
        for i, parameter in enumerate(self.parameters):
            if f"{name}_{i}_step" in state:
                step = state[f"{name}_{i}_step"].clone().to(parameter.device)
                moments = {k: state[f"{name}_{i}_{k}"].clone().to(parameter.device) for k in MOMENTS}
                self._of_parameter[i] = {"step": step, **moments}
