"""What a step of the joint optimisation asks of a GPU outside of the field's kernels: launches, and no waiting.

The step runs on torch's "meta" device in place of a GPU: its tensors have shapes but no values. Whatever needs a value
on the host would wait for a GPU, and raises here; what moves values between host and device is listed.

    python -m benchmarks.gpu.launches
"""

from __future__ import annotations

import copy
import traceback
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from unittest.mock import patch

import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

import biresnerf
from benchmarks.speed import scene
from biresnerf.field.occupancy import DeviceOccupancyGrid
from biresnerf.field.radiance_field import Marching, PositionGradient, Rays, Rendering
from biresnerf.geometry.camera.camera import Intrinsics
from biresnerf.refinement.optimise.joint_optimiser import OCCUPANCY_PERIOD, JointOptimiser

GPU = torch.device("meta")
LIBRARY = str(Path(biresnerf.__file__).parent)
MOVES_NOTHING = {
    "alias", "as_strided", "detach", "diagonal", "expand", "permute", "select", "slice", "split", "squeeze",
    "t", "transpose", "unbind", "unsqueeze", "view", "_unsafe_view", "_reshape_alias",
    "empty", "empty_like", "empty_strided", "new_empty", "lift_fresh",
}  # fmt: skip


@dataclass
class Trace:
    """What a step asks of the device outside of the field.

    Attributes:
        launches: operations by name, views and empty buffers left out.
        crossings: lines of code that move values between host and device.
    """

    launches: Counter[str] = field(default_factory=Counter)
    crossings: list[str] = field(default_factory=list)


class Recorder(TorchDispatchMode):
    def __init__(self) -> None:
        super().__init__()
        self.trace = Trace()

    def __torch_dispatch__(self, function, types, args=(), kwargs=None):
        result = function(*args, **(kwargs or {}))
        name = function.overloadpacket.__name__
        devices = {tensor.device.type for tensor in _tensors((args, result)) if tensor.ndim}
        if name not in MOVES_NOTHING and "meta" in devices:
            self.trace.launches[name] += 1
        if devices == {"meta", "cpu"}:
            self.trace.crossings.append(_line())
        return result


class PretendedField:
    """A field of two lines, differentiable in the rays."""

    stratified, unbounded = None, False

    def reach(self, share: float) -> None:
        pass

    def render(self, rays: Rays, marching: Marching, gradient: PositionGradient) -> Rendering:
        colour = torch.sigmoid(rays.origin + rays.direction) * rays.background
        return Rendering(colour, colour.mean(1), colour.mean(1), 100)

    def step(self, rates: object) -> None:
        pass

    def density_of_first(self, count: Tensor, position: Tensor) -> Tensor:
        return position.sum(1).abs()


class PretendedGenerator:
    device = GPU

    def initial_seed(self) -> int:
        return 0


class PretendedMetrics:
    """In place of the copy that runs beside the next step (`AsyncMetrics`)."""

    def read(self, *metrics: Tensor) -> list[float]:
        return [0.0] * len(metrics)


def pretended_directions(lenses: Intrinsics, image: Tensor, xy: Tensor) -> Tensor:
    """In place of the kernel that finds viewing directions (`cuda/lens.py`)."""
    return torch.cat([xy.double() / lenses.fx[image, None], torch.ones_like(xy[:, :1])], 1)


def traced_step(optimiser: JointOptimiser, *, looks_at_cells: bool = False) -> Trace:
    """What a step asks for after the first, which puts constants on the device.

    Args:
        looks_at_cells: whether it is one of those that update the occupancy grid.
    """
    made, recorder = _on_pretended_gpu(optimiser), Recorder()
    rand, randint = torch.rand, torch.randint
    with (
        patch.object(torch, "rand", lambda *size, generator=None, **where: rand(*size, **where)),
        patch.object(torch, "randint", lambda *size, generator=None, **where: randint(*size, **where)),
    ):
        made.step()
        made.step_index = OCCUPANCY_PERIOD * 2 + (0 if looks_at_cells else 1)
        with recorder:
            made.step()
    return recorder.trace


def _on_pretended_gpu(optimiser: JointOptimiser) -> JointOptimiser:
    """A copy of an optimiser with its tensors on the device, except counts of Adam's steps."""

    def moved(tensor: Tensor, memo: dict[int, Tensor]) -> Tensor:
        if id(tensor) not in memo:
            made = tensor.detach().to(GPU) if tensor.ndim else tensor.clone()
            memo[id(tensor)] = made.requires_grad_(tensor.requires_grad)
        return memo[id(tensor)]

    others = {
        torch.device: lambda device, memo: GPU,
        torch.Generator: lambda made, memo: PretendedGenerator(),
    }
    left = {id(optimiser.field): PretendedField(), id(optimiser._images): optimiser._images}
    with patch.object(Tensor, "__deepcopy__", moved), patch.dict(copy._deepcopy_dispatch, others):
        made = copy.deepcopy(optimiser, left)
    made.metrics, made.directions = PretendedMetrics(), pretended_directions
    made.occupancy = DeviceOccupancyGrid(optimiser.occupancy.side, GPU)
    return made


def _tensors(value: object) -> Iterator[Tensor]:
    if isinstance(value, Tensor):
        yield value
    elif isinstance(value, (tuple, list)):
        for part in value:
            yield from _tensors(part)


def _line() -> str:
    own = [frame for frame in traceback.extract_stack() if frame.filename.startswith(LIBRARY)]
    return f"{Path(own[-1].filename).name}: {own[-1].line}"


def main() -> None:
    for stage in ("coarse", "fine"):
        launches = traced_step(scene.optimiser(stage, images=100, threads=2, rays=1024)).launches
        print(
            f"{stage}: {launches.total()} launches;",
            ", ".join(f"{n} {k}" for k, n in launches.most_common(12)),
        )


if __name__ == "__main__":
    main()
