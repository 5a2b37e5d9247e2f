"""The field on grid encodings: its parameters, and the optimiser step all its backends share.

Two encodings, named by their job as in the paper: the pose-estimation module (low resolution, dense) and the
reconstruction module (high resolution, hashed). In stage 2 their features stand side by side; the reconstruction
module's columns of the first layer start at zero, so switching it on leaves the function exactly as it was.

A field of one encoding has it as the pose-estimation module; its other grid has no levels.
"""

from __future__ import annotations

import math
from abc import abstractmethod

import numpy as np
import torch
from torch import Tensor

from biresnerf.field.adam import Adam
from biresnerf.field.coarse_to_fine import level_mixing
from biresnerf.field.grid_levels import FEATURES
from biresnerf.field.radiance_field import FieldRates, FieldShape, RadianceField
from biresnerf.field.spherical_harmonics import VIEW_FEATURES

MODULES = ("pose", "reconstruction")
HIDDEN, OUTPUTS = 64, 16
TABLE_INIT = 1e-4  # uniform +-1e-4, as tiny-cuda-nn
BETA1, BETA2, EPSILON = 0.9, 0.99, 1e-15


class GridField(RadianceField):
    """Parameters and optimiser state; backends add `render`, `density` and the table update.

    `grids`, `tables`, `moments` and `steps` have an entry for each of `MODULES`.
    """

    def __init__(self, shape: FieldShape, seed: int, device: torch.device) -> None:
        self.shape, self.device, self.unbounded = shape, device, shape.unbounded
        self.reconstructing = False
        self.grids = dict(zip(MODULES, (shape.pose_grid, shape.reconstruction_grid), strict=True))
        self._generator = torch.Generator().manual_seed(seed)
        self.pose_table = self._uniform(shape.pose_grid.entries, FEATURES, TABLE_INIT)
        self.reconstruction_table = self._uniform(shape.reconstruction_grid.entries, FEATURES, TABLE_INIT)
        self.networks = self._draw_networks(shape.pose_grid.width)
        high = shape.reconstruction_grid.width
        self.reconstruction_columns = torch.zeros(HIDDEN, high, device=device).requires_grad_()
        self.tables = dict(zip(MODULES, (self.pose_table, self.reconstruction_table), strict=True))
        self.moments = {
            name: (torch.zeros_like(table), torch.zeros_like(table)) for name, table in self.tables.items()
        }
        self.steps = dict.fromkeys(MODULES, 0)
        # Mixing the levels' features is linear, so it is done in the first layer's columns: the backends compute
        # with networks[0] = first @ mixing, and `first` is optimised.
        self._first = self.networks[0]
        self._mixing: Tensor | None = None
        if shape.broadcast:
            self._first = self.networks[0].detach().clone().requires_grad_()
            self.reach(0.0)
        self._networks_adam = self._adam([self._first, *self.networks[1:]])
        self._columns_adam = self._adam([self.reconstruction_columns])

    def _uniform(self, rows: int, columns: int, bound: float) -> Tensor:
        values = torch.rand(rows, columns, generator=self._generator) * (2 * bound) - bound
        return values.to(self.device)

    def _draw_networks(self, width: int) -> list[Tensor]:
        """The five layers on `width` features, Xavier."""
        sizes = (
            (HIDDEN, width),
            (OUTPUTS, HIDDEN),
            (HIDDEN, VIEW_FEATURES + OUTPUTS),
            (HIDDEN, HIDDEN),
            (3, HIDDEN),
        )
        return [
            self._uniform(rows, columns, math.sqrt(6 / (rows + columns))).requires_grad_()
            for rows, columns in sizes
        ]

    def _adam(self, parameters: list[Tensor]) -> Adam:
        return Adam(parameters, betas=(BETA1, BETA2), eps=EPSILON)

    @property
    def modules(self) -> tuple[str, ...]:
        """The encodings in use."""
        return MODULES if self.reconstructing else MODULES[:1]

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
        for name in self.modules:
            self.steps[name] += 1
            self._update_table(name, self._level_rates(name, rates))
        if self._mixing is not None and self.networks[0].grad is not None:
            self._first.grad = self.networks[0].grad @ self._mixing.T
        self._networks_adam.step(rates.networks)
        self._mix()
        if self.reconstructing:
            self._columns_adam.step(rates.reconstruction_columns)
        self.discard_gradients()

    def _level_rates(self, name: str, rates: FieldRates) -> np.ndarray:
        """The rate float32 [levels] of each level of a module."""
        if name == "pose":
            return np.full(self.shape.pose_grid.levels, rates.pose, np.float32)
        return np.asarray(rates.reconstruction, np.float32)

    def discard_gradients(self) -> None:
        for parameter in (*self.tables.values(), self._first, *self.networks, self.reconstruction_columns):
            parameter.grad = None

    def _tensors(self) -> dict[str, Tensor]:
        """Tables, weights and the tables' moments, shared."""
        tensors = {f"{name}_table": table for name, table in self.tables.items()}
        for name, (first, second) in self.moments.items():
            tensors[f"{name}_moment1"], tensors[f"{name}_moment2"] = first, second
        tensors |= {
            f"network{i}": weight.detach() for i, weight in enumerate([self._first, *self.networks[1:]])
        }
        return tensors | {"reconstruction_columns": self.reconstruction_columns.detach()}

    def state(self) -> dict[str, Tensor]:
        state = self._tensors()
        state.update(self._networks_adam.state("adam_networks"))
        state.update(self._columns_adam.state("adam_columns"))
        state["counters"] = torch.tensor([*self.steps.values(), int(self.reconstructing)])
        return state

    def load_state(self, state: dict[str, Tensor]) -> None:
        with torch.no_grad():
            for name, tensor in self._tensors().items():
                tensor.copy_(state[name])
        *steps, reconstructing = state["counters"].tolist()
        self.steps = dict(zip(MODULES, steps, strict=True))
        self.reconstructing = bool(reconstructing)
        self._networks_adam.load_state("adam_networks", state)
        self._columns_adam.load_state("adam_columns", state)
        self._mix()
