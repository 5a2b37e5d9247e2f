"""Compile every CUDA kernel for compute capabilities, without a GPU: `python -m benchmarks.gpu.compile_cuda 80 90`.

The interpreter that runs the kernels in tests is more forgiving than the compiler. Prints each kernel's shared memory,
registers per thread, and how much of them is spilt to the stack (bytes).
"""

from __future__ import annotations

import argparse
import re
import subprocess
import tempfile
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from itertools import chain, product
from pathlib import Path
from typing import Any

import torch
import triton
from triton.backends.compiler import GPUTarget
from triton.compiler import ASTSource

from biresnerf.field.cuda import plans
from biresnerf.field.cuda.cameras import lens
from biresnerf.field.cuda.cameras.kernels import cast, cast_backward, move, move_backward
from biresnerf.field.cuda.cameras.poses_and_rays import BLOCK
from biresnerf.field.cuda.launches import Launch, bind
from biresnerf.field.cuda.workspace import Capacity, Workspace
from biresnerf.field.grid_levels import grid_levels
from biresnerf.field.radiance_field import FieldShape
from biresnerf.field.reference.field import ReferenceField
from biresnerf.geometry.camera.distortion import NEWTON_STEPS

POINTERS = {
    torch.float64: "*fp64", torch.float32: "*fp32", torch.int32: "*i32", torch.int64: "*i64", torch.uint8: "*u8",
}  # fmt: skip
ALIGNED = 16
CUOBJDUMP = Path(triton.__file__).parent / "backends" / "nvidia" / "bin" / "cuobjdump"


# Rays, samples, samples of a ray, cells along a side of the occupancy grid: round, and as they come.
CAPACITIES = (Capacity(256, 1024, 768, 8), Capacity(250, 1003, 77, 1))


@dataclass(frozen=True)
class Usage:
    """The resources of a compiled kernel: shared memory (bytes); registers and stack (bytes) per thread."""

    shared: int
    registers: int
    stack: int


def kernels() -> dict[str, Launch]:
    """Every kernel, by its name, constants and specialised arguments, at the paper's encodings."""
    found: dict[str, Launch] = {}
    _add(found, cameras())
    for unbounded, reconstructing, capacity in product((False, True), (False, True), CAPACITIES):
        shape = FieldShape(grid_levels(3, 16, 72, 22), grid_levels(16, 128, 4096, 10), unbounded)
        field = ReferenceField(shape, 0, torch.device("cpu"))
        field.reconstructing = reconstructing
        workspace = Workspace(field, capacity)
        made = [plan(workspace, merged=True) for plan in (plans.forward, plans.viewing)]
        made += [plans.backward(workspace), plans.density(workspace, whole=True)]
        made += [plans.update(workspace, name) for name in workspace.modules]
        _add(found, (launch for launch in chain.from_iterable(made) if isinstance(launch, Launch)))
    return found


def cameras() -> Iterator[Launch]:
    """The kernels of viewing directions, poses and rays, for counts divisible by 16 and others."""
    matrices, vectors = torch.zeros(1, 3, 4), torch.zeros(1, 3)
    poses = {"matrices": matrices, "g_matrices": matrices, "start": matrices, "length": torch.zeros(1)}
    rays = dict.fromkeys(("origin", "direction", "g_origin", "g_direction", "in_cam"), vectors)
    increments = dict.fromkeys(("rotation", "translation", "g_rotation", "g_translation"), vectors)
    indices = {name: torch.zeros(1, dtype=torch.int64) for name in ("body", "camera", "image")}
    lenses = {name: torch.zeros(9).double() for name in ("fx", "fy", "cx", "cy", "distortion")}
    pixels = {"xy": vectors, "out": vectors, "fisheye": torch.zeros(1, dtype=torch.uint8)}
    buffers = {**poses, **rays, **increments, **indices, **lenses, **pixels}
    for n in (64, 1001):
        for kernel in (move, move_backward, cast, cast_backward):
            yield bind(kernel, (1,), buffers, n=n, BLOCK=BLOCK)
        for steps, fisheye in product((0, NEWTON_STEPS), (False, True)):
            yield bind(lens.directions, (1,), buffers, n=n, STEPS=steps, FISHEYE=fisheye, BLOCK=lens.BLOCK)


def _add(found: dict[str, Launch], launches: Iterable[Launch]) -> None:
    for launch in launches:
        constants, _, attributes = _specialised(launch)
        told = [launch.kernel.fn.__name__, *map(str, constants.values())]
        told.append("".join("a" if (i,) in attributes else "-" for i in range(len(launch.arguments))))
        found.setdefault(" ".join(told), launch)


def _specialised(launch: Launch) -> tuple[dict[str, Any], dict[str, str], dict[tuple[int], Any]]:
    """Constants, types and specialisations of the arguments, as a launch would pass them to the compiler.

    Triton specialises by value: a pointer or number divisible by 16, and the number one.
    """
    constants: dict[str, Any] = {}
    signature: dict[str, str] = {}
    attributes: dict[tuple[int], Any] = {}
    for i, parameter in enumerate(launch.kernel.params):
        value = launch.arguments[parameter.name]
        if parameter.is_constexpr or (isinstance(value, int) and value == 1):
            constants[parameter.name], signature[parameter.name] = value, "constexpr"
            continue
        tensor = isinstance(value, torch.Tensor)
        signature[parameter.name] = POINTERS[value.dtype] if tensor else "i32"
        # The allocator aligns its memory; slices may begin anywhere.
        begins = value.storage_offset() * value.element_size() if tensor else value
        if begins % ALIGNED == 0:
            attributes[(i,)] = [["tt.divisibility", ALIGNED]]
    return constants, signature, attributes


def compiled(launch: Launch, capability: int) -> Usage:
    """The resources of a kernel, compiled for a compute capability."""
    constants, signature, attributes = _specialised(launch)
    found = triton.compile(
        ASTSource(launch.kernel, signature=signature, constexprs=constants, attrs=attributes),
        target=GPUTarget("cuda", capability, 32),
        options={"num_warps": launch.warps, "num_stages": 1},
    )
    with tempfile.NamedTemporaryFile(suffix=".cubin") as file:
        file.write(found.asm["cubin"])
        file.flush()
        usage = subprocess.run(
            [CUOBJDUMP, "--dump-resource-usage", file.name], capture_output=True, text=True, check=True
        )
    taken = re.search(r"REG:(\d+) STACK:(\d+)", usage.stdout)
    assert taken is not None, usage.stdout
    return Usage(int(found.metadata.shared), int(taken[1]), int(taken[2]))


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("capabilities", type=int, nargs="*", default=[80, 90])
    for capability in parser.parse_args().capabilities:
        print(f"{f'capability {capability}':60}{'shared':>8}{'registers':>11}{'stack':>8}")
        for told, launch in kernels().items():
            usage = compiled(launch, capability)
            print(f"{told[:59]:60}{usage.shared:>8}{usage.registers:>11}{usage.stack:>8}", flush=True)


if __name__ == "__main__":
    main()
