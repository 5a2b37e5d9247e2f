"""The field on grid encodings: its parameters, and the optimiser step all its backends share.

Two encodings, named by their job as in the paper: the pose-estimation module (low resolution, dense) and the
reconstruction module (high resolution, hashed). Their features are concatenated; the reconstruction module's
columns of the first layer start at zero, so switching it on leaves the function exactly as it was.

A field of one encoding has its grid in the place of the pose-estimation module, and no levels in the other.
"""

from __future__ import annotations

import math
from abc import abstractmethod

import numpy as np
import torch
from torch import Tensor

from biresnerf.field.adam_state import adam_state, load_adam_state
from biresnerf.field.coarse_to_fine import level_mixing
from biresnerf.field.grid_levels import FEATURES
from biresnerf.field.radiance_field import (
    BETA1,
    BETA2,
    EPSILON,
    HIDDEN,
    OUTPUTS,
    TABLE_INIT,
    FieldRates,
    FieldShape,
    RadianceField,
)
from biresnerf.field.spherical_harmonics import VIEW_FEATURES


class GridField(RadianceField):
    """Parameters and optimiser state; backends add `render`, `density` and the table update."""

    def __init__(self, shape: FieldShape, seed: int, device: torch.device) -> None:
        self.shape, self.device, self.unbounded = shape, device, shape.unbounded
        self.reconstructing = False
        generator = torch.Generator().manual_seed(seed)

        def uniform(rows: int, columns: int, bound: float) -> Tensor:
            values = torch.rand(rows, columns, generator=generator) * (2 * bound) - bound
            return values.to(device)

        def layer(rows: int, columns: int) -> Tensor:
            return uniform(rows, columns, math.sqrt(6 / (rows + columns))).requires_grad_()  # Xavier

        self.pose_table = uniform(shape.pose_grid.entries, FEATURES, TABLE_INIT)
        self.reconstruction_table = uniform(shape.reconstruction_grid.entries, FEATURES, TABLE_INIT)
        self.networks = [
            layer(HIDDEN, shape.pose_grid.width),
            layer(OUTPUTS, HIDDEN),
            layer(HIDDEN, VIEW_FEATURES + OUTPUTS),
            layer(HIDDEN, HIDDEN),
            layer(3, HIDDEN),
        ]
        self.reconstruction_columns = torch.zeros(
            HIDDEN, shape.reconstruction_grid.width, device=device
        ).requires_grad_()
        self.moments = {
            name: (torch.zeros_like(table), torch.zeros_like(table))
            for name, table in (("pose", self.pose_table), ("reconstruction", self.reconstruction_table))
        }
        self.steps = {"pose": 0, "reconstruction": 0}
        # Mixing the levels' features is linear, so it is done in the first layer's columns: the backends compute
        # with networks[0] = first @ mixing, and what is learnt is `first`.
        self._first = self.networks[0]
        self._mixing: Tensor | None = None
        if shape.broadcast:
            self._first = self.networks[0].detach().clone().requires_grad_()
            self.reach(0.0)
        fused = True if device.type == "cuda" else None  # one launch instead of a dozen
        self._networks_adam = torch.optim.Adam(
            [self._first, *self.networks[1:]], betas=(BETA1, BETA2), eps=EPSILON, fused=fused
        )
        self._columns_adam = torch.optim.Adam(
            [self.reconstruction_columns], betas=(BETA1, BETA2), eps=EPSILON, fused=fused
        )

    @abstractmethod
    def _update_table(self, name: str, rates: np.ndarray) -> None:
        """Adam on one table from the gradients of the last backward, entries without gradient left alone."""

    def reach(self, progress: float) -> None:
        if self.shape.broadcast:
            mixing = np.kron(level_mixing(progress, self.shape.pose_grid.levels), np.eye(FEATURES))
            self._mixing = torch.as_tensor(mixing, dtype=torch.float32, device=self.device)
            self._mix()

    def _mix(self) -> None:
        if self._mixing is not None:
            with torch.no_grad():
                self.networks[0].copy_(self._first @ self._mixing)

    def start_reconstruction(self) -> None:
        self.reconstructing = True

    def step(self, rates: FieldRates) -> None:
        """One Adam step from the gradients of the last backward."""
        self.steps["pose"] += 1
        self._update_table("pose", np.full(self.shape.pose_grid.levels, rates.pose, np.float32))
        if self._mixing is not None and self.networks[0].grad is not None:
            self._first.grad = self.networks[0].grad @ self._mixing.T
        self._step_networks(self._networks_adam, rates.networks)
        self._mix()
        if self.reconstructing:
            self.steps["reconstruction"] += 1
            self._update_table("reconstruction", np.asarray(rates.reconstruction, np.float32))
            self._step_networks(self._columns_adam, rates.reconstruction_columns)
        self.discard_gradients()

    @staticmethod
    def _step_networks(optimiser: torch.optim.Optimizer, rate: float) -> None:
        optimiser.param_groups[0]["lr"] = rate
        optimiser.step()
        optimiser.zero_grad(set_to_none=True)

    def _learnt(self) -> list[Tensor]:
        return [self._first, *self.networks[1:]]

    def state(self) -> dict[str, Tensor]:
        state = {"pose_table": self.pose_table, "reconstruction_table": self.reconstruction_table}
        for name, (first, second) in self.moments.items():
            state[f"{name}_moment1"], state[f"{name}_moment2"] = first, second
        for i, weight in enumerate(self._learnt()):
            state[f"network{i}"] = weight.detach()
        state["reconstruction_columns"] = self.reconstruction_columns.detach()
        state.update(adam_state("adam_networks", self._networks_adam))
        state.update(adam_state("adam_columns", self._columns_adam))
        counters = [self.steps["pose"], self.steps["reconstruction"], int(self.reconstructing)]
        state["counters"] = torch.tensor(counters)
        return state

    def load_state(self, state: dict[str, Tensor]) -> None:
        with torch.no_grad():
            self.pose_table.copy_(state["pose_table"])
            self.reconstruction_table.copy_(state["reconstruction_table"])
            for name, (first, second) in self.moments.items():
                first.copy_(state[f"{name}_moment1"])
                second.copy_(state[f"{name}_moment2"])
            for i, weight in enumerate(self._learnt()):
                weight.copy_(state[f"network{i}"])
            self.reconstruction_columns.copy_(state["reconstruction_columns"])
        load_adam_state("adam_networks", self._networks_adam, state)
        load_adam_state("adam_columns", self._columns_adam, state)
        self._mix()
        pose, reconstruction, reconstructing = state["counters"].tolist()
        self.steps = {"pose": pose, "reconstruction": reconstruction}
        self.reconstructing = bool(reconstructing)
