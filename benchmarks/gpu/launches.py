"""A joint optimisation step's GPU operations outside the field's kernels: counts launches, finds waits.

The step runs on torch's "meta" device in place of a GPU: its tensors have shapes but no values. Whatever needs a value
on the host would wait for a GPU, and raises here; what moves values between host and device is listed.

    python -m benchmarks.gpu.launches
"""

from __future__ import annotations

import copy
import linecache
import sys
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
from biresnerf.field.cuda.cameras import poses_and_rays
from biresnerf.field.occupancy import DeviceOccupancyGrid
from biresnerf.field.radiance_field import Marching, PositionGradient, Rays, Rendering
from biresnerf.geometry.camera.camera import Intrinsics
from biresnerf.refinement.optimise import renderer
from biresnerf.refinement.optimise.joint_optimiser import JointOptimiser
from biresnerf.refinement.parameters import pose_parameters

GPU = torch.device("meta")
LIBRARY = str(Path(biresnerf.__file__).parent)
MOVES_NOTHING = {
    "alias", "as_strided", "detach", "diagonal", "expand", "permute", "select", "slice", "split", "squeeze",
    "t", "transpose", "unbind", "unsqueeze", "view", "_unsafe_view", "_reshape_alias",
    "empty", "empty_like", "empty_strided", "new_empty", "lift_fresh",
}  # fmt: skip
# torch has none for tensors without values. It returns nothing.
_ADAM = torch.library.Library("aten", "IMPL", "Meta")
_ADAM.impl("_fused_adam_.tensor_lr", lambda *arguments, **others: None)


@dataclass
class Trace:
    """A step's device operations outside of the field.

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

    def estimate(self, position: Tensor, count: Tensor) -> Tensor:
        return position.sum(1).abs()


class PretendedGenerator:
    device = GPU

    def initial_seed(self) -> int:
        return 0


class PretendedMetrics:
    """Replaces the copy that runs beside the next step (`AsyncMetrics`)."""

    def read(self, *metrics: Tensor) -> list[float]:
        return [0.0] * len(metrics)


def pretended_directions(lenses: Intrinsics, image: Tensor, xy: Tensor) -> Tensor:
    """Replaces the kernel that finds viewing directions (`cuda/cameras/lens.py`)."""
    return torch.cat([xy.double() / lenses.fx[image, None], torch.ones_like(xy[:, :1])], 1)


def traced_step(optimiser: JointOptimiser, *, looks_at_cells: bool = False) -> Trace:
    """The operations of a step, traced after a first one that moves constants to the device.

    Args:
        looks_at_cells: trace a step that updates the occupancy grid.
    """
    recorder = Recorder()
    made = _on_pretended_gpu(optimiser)
    rand, randint, rays = torch.rand, torch.randint, made.rays

    def launch(kernel: str, *arguments: object) -> None:
        recorder.trace.launches[kernel] += 1

    with (
        patch.object(pose_parameters, "camera_kernels", lambda device: poses_and_rays),
        patch.object(renderer, "camera_kernels", lambda device: poses_and_rays),
        patch.object(poses_and_rays, "_launch", launch),
        patch.object(torch, "rand", lambda *size, generator=None, **where: rand(*size, **where)),
        patch.object(torch, "randint", lambda *size, generator=None, **where: randint(*size, **where)),
    ):
        made.step_index = 2 * made.schedule.numbers.occupancy_period - (1 if looks_at_cells else 0)
        made.step()
        made.rays, recorder.trace = rays, Trace()
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
    """The library's line that requests an operation; for the backward pass, the line that starts it."""
    frame = sys._getframe()
    while frame.f_back and not frame.f_code.co_filename.startswith(LIBRARY):
        frame = frame.f_back
    path = frame.f_code.co_filename
    return f"{Path(path).name}: {linecache.getline(path, frame.f_lineno).strip()}"


def main() -> None:
    for stage in ("coarse", "fine"):
        optimiser = scene.untrained(images=100, threads=2, size=64, preset="paper")
        if stage == "fine":
            optimiser.start_reconstruction()
        launches = traced_step(optimiser).launches
        most = ", ".join(f"{n} {k}" for k, n in launches.most_common(12))
        print(f"{stage}: {launches.total()} launches; {most}")


if __name__ == "__main__":
    main()
