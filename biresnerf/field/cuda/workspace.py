"""The device memory of a field's kernels: buffers of fixed capacity, under the names of the kernels' parameters."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from biresnerf.field.cuda.launches import Plan
from biresnerf.field.grid_field import OUTPUTS, GridField
from biresnerf.field.grid_levels import GridLevels
from biresnerf.field.radiance_field import Marching, Merging, PositionGradient
from biresnerf.field.spherical_harmonics import VIEW_FEATURES

CONTROLS = (
    "ray_count", "trained_rays", "interval", "near", "far",
    "pose_smoothing", "reconstruction_smoothing", "pose_share", "reconstruction_share",
    "merged_light", "merged_most",
)  # fmt: skip
PROGRAMS_ELSEWHERE = 3

Controls = Mapping[str, float | Sequence[float]]


@dataclass(frozen=True)
class Pass:
    """What is rendered at once: rays, those of them that teach the field, and the samples to expect."""

    rays: int
    trained: int
    marching: Marching
    gradient: PositionGradient
    samples: int

    def controls(self) -> dict[str, float]:
        """The values of `CONTROLS`."""
        marching, gradient, merging = self.marching, self.gradient, self.marching.merging or Merging(0.0, 0)
        return {
            "ray_count": self.rays, "trained_rays": self.trained,
            "interval": marching.step, "near": marching.near, "far": marching.far,
            "pose_smoothing": gradient.pose_smoothing, "pose_share": 1.0,
            "reconstruction_smoothing": gradient.reconstruction_smoothing,
            "reconstruction_share": gradient.reconstruction_share,
            "merged_light": merging.light, "merged_most": merging.most,
        }  # fmt: skip


@dataclass(frozen=True)
class Capacity:
    """Rays and samples that fit, samples a ray may have, and cells a side of the occupancy grid."""

    rays: int
    samples: int
    most: int
    side: int

    def holds(self, other: Capacity) -> bool:
        fits = self.rays >= other.rays and self.samples >= other.samples and self.most >= other.most
        return fits and self.side == other.side


class Workspace:
    """Buffers of one capacity and the plans bound to them. A field makes another when it needs a larger one."""

    def __init__(self, field: GridField, capacity: Capacity) -> None:
        self.capacity, self.shape, self.device = capacity, field.shape, field.device
        self.modules, self.grids = field.modules, field.grids
        self.width = sum(self.grids[name].width for name in self.modules)
        self.programs = (
            torch.cuda.get_device_properties(self.device).multi_processor_count
            if self.device.type == "cuda"
            else PROGRAMS_ELSEWHERE
        )
        columns = [field.reconstruction_columns] if field.reconstructing else []
        # In the order in which the two backward kernels sum their gradients.
        self.density_weights = [*field.networks[:2], *columns]
        self.colour_weights = field.networks[2:]
        sizes = dict.fromkeys(CONTROLS, 1)
        for name in self.modules:
            sizes |= {f"{name}_rates": self.grids[name].levels, f"{name}_corrections": 2}
        ends = np.cumsum([0, *sizes.values()]).tolist()
        self._places = dict(zip(sizes, map(slice, ends, ends[1:]), strict=True))
        self._told = [0.0] * ends[-1]  # what the device's memory holds
        self._controls = torch.zeros(ends[-1], device=self.device)
        self.controls = {name: self._controls[place] for name, place in self._places.items()}
        self.buffers: dict[str, Tensor] = {
            **self._rays(),
            **self._samples(),
            **{name: self.controls[name] for name in CONTROLS},
            **dict(zip(("w1", "w2", "w3", "w4", "w5"), field.networks, strict=True)),
            "columns": field.reconstruction_columns,
        }
        self.tables = {
            name: {
                **_level_buffers(self.grids[name], field.tables[name], field.moments[name]),
                "rates": self.controls[f"{name}_rates"],
                "corrections": self.controls[f"{name}_corrections"],
            }
            for name in self.modules
        }
        self._plans: dict[tuple[Any, ...], Plan] = {}

    def plan(self, launches: Callable[..., list[Any]], *arguments: str | bool) -> Plan:
        """The plan that `launches` makes for this workspace and these arguments, made once."""
        key = (launches, *arguments)
        if key not in self._plans:
            self._plans[key] = Plan(launches(self, *arguments), self.device)
        return self._plans[key]

    def write_controls(self, values: Controls) -> None:
        """Set, in one copy, some of what changes from step to step."""
        for name, value in values.items():
            self._told[self._places[name]] = value if isinstance(value, Sequence) else [value]
        # Memory that is not pinned is copied aside before the call returns, so the host neither waits nor races.
        self._controls.copy_(torch.tensor(self._told), non_blocking=True)

    def record(self) -> None:
        """Make graphs of all plans that have run."""
        for plan in self._plans.values():
            plan.record()

    def weight_gradients(self) -> list[Tensor]:
        """The gradients of the density and the colour weights, as views of the buffers that hold them."""
        gradients = []
        for name, weights in (
            ("g_density_weights", self.density_weights),
            ("g_colour_weights", self.colour_weights),
        ):
            parts = self.buffers[name].split([weight.numel() for weight in weights])
            gradients += [part.view(weight.shape) for part, weight in zip(parts, weights, strict=True)]
        return gradients

    def _rays(self) -> dict[str, Tensor]:
        n = self.capacity.rays
        shapes = {
            "origin": (n, 3), "direction": (n, 3), "background": (n, 3), "jitter": (n,),
            "middle": (n, self.capacity.most), "length": (n, self.capacity.most), "view": (n, VIEW_FEATURES),
            "ray_colour": (n, 3), "opacity": (n,), "depth": (n,), "g_ray_colour": (n, 3), "g_opacity": (n,),
            "g_origin": (n, 3), "g_direction": (n, 3), "g_harmonics": (n, VIEW_FEATURES),
        }  # fmt: skip
        side = self.capacity.side
        return {
            **{name: torch.empty(shape, device=self.device) for name, shape in shapes.items()},
            "count": torch.zeros(n, dtype=torch.int32, device=self.device),
            "ray_offset": torch.zeros(n + 1, dtype=torch.int32, device=self.device),
            "taken": torch.zeros(1, dtype=torch.int32, device=self.device),
            "marched": torch.zeros(1, dtype=torch.int32, device=self.device),
            "occupied": torch.zeros(side, side, side, dtype=torch.uint8, device=self.device),
        }

    def _samples(self) -> dict[str, Tensor]:
        n = self.capacity.samples
        density = sum(weight.numel() for weight in self.density_weights)
        colour = sum(weight.numel() for weight in self.colour_weights)
        shapes = {
            "x": (3, n), "t": (n,), "dt": (n,), "density": (n,), "colour": (3, n), "features": (self.width, n),
            "g_density": (n,), "g_colour": (3, n), "g_features": (self.width, n), "g_view": (VIEW_FEATURES, n),
            "g_x": (3, n), "outputs": (OUTPUTS, n), "g_outputs": (OUTPUTS, n),
            "density_sums": (self.programs, density), "g_density_weights": (density,),
            "colour_sums": (self.programs, colour), "g_colour_weights": (colour,),
            **{f"{name}_jacobian": (self.grids[name].levels, 6, n) for name in self.modules},
        }  # fmt: skip
        buffers = {name: torch.empty(shape, device=self.device) for name, shape in shapes.items()}
        return {**buffers, "ray": torch.empty(n, dtype=torch.int32, device=self.device)}


def _level_buffers(grid: GridLevels, table: Tensor, moments: tuple[Tensor, Tensor]) -> dict[str, Tensor]:
    """A module's table (an entry of two float32 also as one int64), its moments and its geometry."""

    def on_device(values: Any, dtype: torch.dtype) -> Tensor:
        return torch.as_tensor(values).to(dtype).to(table.device)

    return {
        "table": table,
        "words": table.view(torch.int64).reshape(-1),
        "gradient": torch.zeros_like(table),
        "moment1": moments[0],
        "moment2": moments[1],
        "scale": on_device(grid.scale, torch.float32),
        "stride": on_device(grid.stride.astype("int64"), torch.int32),
        "hashed": on_device(grid.hashed, torch.int32),
        "offset": on_device(grid.offset, torch.int64),
    }
