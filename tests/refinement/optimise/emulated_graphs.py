"""CUDA graphs without a GPU: what a step launches is recorded, and repeated on the same memory.

As on a GPU, recording leaves everything as it was, memory made meanwhile holds nothing of use before a repetition, and
random numbers come from the generator anew each time. Triton's interpreter runs the kernels.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from unittest.mock import patch

import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode, _disable_current_modes
from torch.utils._pytree import tree_leaves
from triton.runtime.interpreter import GridExecutor

from biresnerf.field.cuda.cameras import lens, poses_and_rays
from biresnerf.refinement.optimise.cast_rays import turned
from biresnerf.refinement.optimise.joint_optimiser import JointOptimiser
from biresnerf.refinement.optimise.step_graphs import Record, StepGraphs

Call = tuple[Callable[..., object], tuple, dict, object]  # what is called, with what, and what came of it


class EmulatedGraph:
    """Calls with the very tensors that they had; `made` are those that were made meanwhile."""

    def __init__(self, calls: list[Call], made: list[Tensor]) -> None:
        self._calls, self._made = calls, made

    def replay(self) -> None:
        for tensor in self._made:
            tensor.untyped_storage().fill_(0x7F)  # huge numbers, as another graph may have used the memory
        with torch._C._AutoDispatchBelowAutograd():
            for function, args, kwargs, recorded in self._calls:
                given = {_memory(tensor) for tensor in _tensors((args, kwargs))}
                found = function(*args, **kwargs)
                for place, value in zip(_tensors(recorded), _tensors(found), strict=True):
                    if _memory(place) not in given:  # neither a view nor changed in place
                        place.copy_(value)


class _Recording(TorchDispatchMode):
    def __init__(self) -> None:
        super().__init__()
        self.calls: list[Call] = []
        self.made: dict[int, Tensor] = {}
        self._before: dict[int, tuple[torch.UntypedStorage, torch.UntypedStorage]] = {}

    def __torch_dispatch__(self, function, types, args=(), kwargs=None):
        kwargs = kwargs or {}
        if function is torch.ops.aten._local_scalar_dense.default:
            raise RuntimeError("a step that is recorded cannot wait for a value")
        self._keep((args, kwargs))
        result = function(*args, **kwargs)
        for tensor in _tensors(result):
            if _memory(tensor) not in self._before:
                self.made.setdefault(_memory(tensor), tensor)
        self.calls.append((function, args, kwargs, result))
        return result

    def launch(self, executor: GridExecutor, run: Callable, args: tuple, kwargs: dict) -> None:
        self.calls.append((partial(run, executor), args, kwargs, None))
        with _disable_current_modes():
            self._keep((args, kwargs))
            run(executor, *args, **kwargs)

    def _keep(self, given: object) -> None:
        """Keep what memory from before held."""
        for tensor in _tensors(given):
            if _memory(tensor) not in self.made:
                storage = tensor.untyped_storage()
                self._before.setdefault(_memory(tensor), (storage, storage.clone()))

    def undo(self) -> None:
        for storage, held in self._before.values():
            storage.copy_(held)


def emulated_graph(work: Callable, draws: torch.Generator, _other: object = None):
    """In place of `cuda_graph`."""
    recording, chance, run = _Recording(), draws.get_state(), GridExecutor.__call__
    launch = lambda executor, *args, **kwargs: recording.launch(executor, run, args, kwargs)  # noqa: E731
    with recording, patch.object(GridExecutor, "__call__", launch):
        outcome = work()
    recording.undo()
    draws.set_state(chance)
    return EmulatedGraph(recording.calls, list(recording.made.values())), outcome


def as_on_a_gpu(optimiser: JointOptimiser, record: Record = emulated_graph) -> StepGraphs:
    """Let an optimiser on the CPU, of a field by Triton, take its steps as on a GPU."""
    poses = optimiser.poses
    poses.matrices = lambda: poses_and_rays.moved_poses(
        poses.rotation, poses.translation, poses._row, poses._length, poses.start
    )
    optimiser.directions = lens.directions_in_cam
    optimiser.camera_errors.add = optimiser.camera_errors.defined_add
    optimiser.graphs = StepGraphs(optimiser, record, check=tuple)
    return optimiser.graphs


def cast_as_on_a_gpu(matrices: Tensor, camera: Tensor, in_cam: Tensor) -> tuple[Tensor, Tensor]:
    """In place of `cast_rays`."""
    if in_cam.requires_grad:
        return turned(matrices[camera], in_cam)
    return poses_and_rays.rays_of_cameras(matrices, camera, in_cam)


def _tensors(value: object) -> list[Tensor]:
    return [leaf for leaf in tree_leaves(value) if isinstance(leaf, Tensor)]


def _memory(tensor: Tensor) -> int:
    return tensor.untyped_storage()._cdata
