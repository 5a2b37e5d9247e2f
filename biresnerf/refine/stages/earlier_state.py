"""The optimisation before its cameras were adjusted, to go back to where photos speak against that."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from biresnerf.refine.optimise.joint_optimiser import JointOptimiser

_PREFIX = "earlier."  # before the names of tensors in a checkpoint


@dataclass(frozen=True, eq=False)
class EarlierState:
    """A copy of all that an optimisation had learnt.

    Attributes:
        error: mean squared error over the block of steps before.
        tensors: of the optimisation.
    """

    error: float
    tensors: dict[str, Tensor]

    @classmethod
    def of(cls, optimiser: JointOptimiser, error: float) -> EarlierState:
        return cls(error, {name: tensor.detach().clone() for name, tensor in optimiser.state().items()})

    @classmethod
    def kept(cls, error: float, tensors: dict[str, Tensor]) -> EarlierState:
        """From the tensors of a checkpoint."""
        own = {k.removeprefix(_PREFIX): v for k, v in tensors.items() if k.startswith(_PREFIX)}
        return cls(error, own)

    def for_checkpoint(self) -> dict[str, Tensor]:
        return {_PREFIX + name: tensor for name, tensor in self.tensors.items()}

    def put_back(self, optimiser: JointOptimiser) -> None:
        """All as it was then, but for the step; poses move again, for all the steps that the run was asked for."""
        optimiser.lenses.forget()  # those that had not moved have no state
        numbers = optimiser.step_state().model_copy(
            update={"poses_held": False, "steps": optimiser.options.steps}
        )
        optimiser.load_state(self.tensors, numbers)
