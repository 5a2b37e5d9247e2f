"""The radiance field: its parameters, what it is asked for, and the optimiser step all backends share.

Two encodings, named by their job as in the paper: the pose-estimation module (low resolution, dense) and the
reconstruction module (high resolution, hashed). Their features are concatenated; the reconstruction module's
columns of the first layer start at zero, so switching it on leaves the function exactly as it was.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from biresnerf.field.grid_levels import FEATURES, GridLevels
from biresnerf.field.spherical_harmonics import VIEW_FEATURES

HIDDEN, OUTPUTS = 64, 16
TABLE_INIT = 1e-4  # uniform +-1e-4, as tiny-cuda-nn
BETA1, BETA2, EPSILON = 0.9, 0.99, 1e-15


@dataclass(frozen=True)
class FieldShape:
    """What the field is made of. `unbounded` scenes are contracted outside the inner box [-1, 1]^3."""

    pose_grid: GridLevels
    reconstruction_grid: GridLevels
    unbounded: bool


@dataclass(frozen=True)
class Rays:
    """Rays in the unit frame: origin, unit direction, background colour [rays, 3], jitter [rays] in [0, 1).

    Only the first `trained` rays give gradients to the field; all give gradients to origin and direction.
    """

    origin: Tensor
    direction: Tensor
    background: Tensor
    jitter: Tensor
    trained: int


@dataclass(frozen=True)
class Marching:
    """Where samples are taken: interval `step`, from `near` to `far` (unit lengths), at most `most` per ray.

    `occupied` is the occupancy grid, uint8 [side, side, side] over (z, y, x) of the grid position.
    """

    step: float
    near: float
    far: float
    most: int
    occupied: Tensor


@dataclass(frozen=True)
class PositionGradient:
    """How the encodings' gradient to positions is shaped (see `reference.straight_through_fraction`).

    `reconstruction_share` scales what the reconstruction module passes on: 0 right after the switch, then 1.
    """

    pose_smoothing: float = 0.0
    reconstruction_smoothing: float = 0.0
    reconstruction_share: float = 1.0


@dataclass(frozen=True)
class FieldRates:
    """Rates of one step: pose module and networks, reconstruction module per level, its first-layer columns."""

    pose: float
    networks: float
    reconstruction: tuple[float, ...]
    reconstruction_columns: float


@dataclass(frozen=True)
class Rendering:
    """Colour [rays, 3], opacity [rays], depth [rays] (unit lengths along the ray) and the samples it took."""

    colour: Tensor
    opacity: Tensor
    depth: Tensor
    samples: int


class RadianceField(ABC):
    """Parameters and optimiser state; backends add `render`, `density` and the table update."""

    backend: str

    def __init__(self, shape: FieldShape, seed: int, device: torch.device) -> None:
        self.shape, self.device = shape, device
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
        self._networks_adam = torch.optim.Adam(self.networks, betas=(BETA1, BETA2), eps=EPSILON)
        self._columns_adam = torch.optim.Adam(
            [self.reconstruction_columns], betas=(BETA1, BETA2), eps=EPSILON
        )

    @abstractmethod
    def render(self, rays: Rays, marching: Marching, gradient: PositionGradient) -> Rendering:
        """Colour, opacity and depth along rays; differentiable to origin and direction.

        Calling backward on the result leaves the trained rays' field gradients ready for `step`.
        """

    @abstractmethod
    def density(self, position: Tensor) -> Tensor:
        """Density [n] per unit length at grid positions [n, 3] in [0, 1]; no gradient."""

    @abstractmethod
    def _update_table(self, name: str, rates: np.ndarray) -> None:
        """Adam on one table from the gradients of the last backward, entries without gradient left alone."""

    @abstractmethod
    def discard_gradients(self) -> None:
        """Forget the gradients of the last backward."""

    def start_reconstruction(self) -> None:
        """From here on the reconstruction module takes part (the switch to stage 2)."""
        self.reconstructing = True

    def step(self, rates: FieldRates) -> None:
        """One Adam step from the gradients of the last backward."""
        self.steps["pose"] += 1
        self._update_table("pose", np.full(self.shape.pose_grid.levels, rates.pose, np.float32))
        self._step_networks(self._networks_adam, rates.networks)
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

    def state(self) -> dict[str, Tensor]:
        """Everything `load_state` needs to go on exactly as before, as flat named tensors."""
        state = {"pose_table": self.pose_table, "reconstruction_table": self.reconstruction_table}
        for name, (first, second) in self.moments.items():
            state[f"{name}_moment1"], state[f"{name}_moment2"] = first, second
        for i, weight in enumerate(self.networks):
            state[f"network{i}"] = weight.detach()
        state["reconstruction_columns"] = self.reconstruction_columns.detach()
        for prefix, optimiser in (("networks", self._networks_adam), ("columns", self._columns_adam)):
            for i, entry in optimiser.state_dict()["state"].items():
                for key, value in entry.items():
                    state[f"adam_{prefix}_{i}_{key}"] = torch.as_tensor(value)
        counters = [self.steps["pose"], self.steps["reconstruction"], int(self.reconstructing)]
        state["counters"] = torch.tensor(counters)
        return state

    def load_state(self, state: dict[str, Tensor]) -> None:
        """Restore what `state` returned, in place."""
        with torch.no_grad():
            self.pose_table.copy_(state["pose_table"])
            self.reconstruction_table.copy_(state["reconstruction_table"])
            for name, (first, second) in self.moments.items():
                first.copy_(state[f"{name}_moment1"])
                second.copy_(state[f"{name}_moment2"])
            for i, weight in enumerate(self.networks):
                weight.copy_(state[f"network{i}"])
            self.reconstruction_columns.copy_(state["reconstruction_columns"])
        for prefix, optimiser in (("networks", self._networks_adam), ("columns", self._columns_adam)):
            saved = optimiser.state_dict()
            saved["state"] = {}
            for i in range(len(saved["param_groups"][0]["params"])):
                head = f"adam_{prefix}_{i}_"
                entry = {k[len(head) :]: v.clone() for k, v in state.items() if k.startswith(head)}
                if entry:
                    saved["state"][i] = entry
            optimiser.load_state_dict(saved)
        pose, reconstruction, reconstructing = state["counters"].tolist()
        self.steps = {"pose": pose, "reconstruction": reconstruction}
        self.reconstructing = bool(reconstructing)
