"""Compile every CUDA kernel for compute capabilities, without a GPU: `python -m benchmarks.gpu.compile_cuda 80 90`.

The interpreter that runs the kernels in tests is more forgiving than the compiler. Prints what each kernel takes:
shared memory, registers of a thread and what of them is spilt to the stack (bytes).
"""

from __future__ import annotations

import re
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from itertools import chain, product
from pathlib import Path
from typing import Any

import torch
import triton
from triton.backends.compiler import GPUTarget
from triton.compiler import ASTSource

from biresnerf.field.cuda import plans
from biresnerf.field.cuda.launches import Launch
from biresnerf.field.cuda.workspace import Capacity, Workspace
from biresnerf.field.grid_levels import grid_levels
from biresnerf.field.radiance_field import FieldShape
from biresnerf.field.reference.field import ReferenceField

POINTERS = {torch.float32: "*fp32", torch.int32: "*i32", torch.int64: "*i64", torch.uint8: "*u8"}
ALIGNED = 16
CUOBJDUMP = Path(triton.__file__).parent / "backends" / "nvidia" / "bin" / "cuobjdump"


# Rays, samples, samples of a ray, cells along a side of the occupancy grid: round, and as they come.
CAPACITIES = (Capacity(256, 1024, 768, 8), Capacity(250, 1003, 77, 1))


@dataclass(frozen=True)
class Usage:
    """What a compiled kernel takes: shared memory (bytes); registers and stack (bytes) of a thread."""

    shared: int
    registers: int
    stack: int


def kernels() -> dict[str, Launch]:
    """Every kernel, by its name, constants and specialised arguments, at the paper's encodings."""
    found: dict[str, Launch] = {}
    for unbounded, reconstructing, capacity in product((False, True), (False, True), CAPACITIES):
        shape = FieldShape(grid_levels(3, 16, 72, 22), grid_levels(16, 128, 4096, 10), unbounded)
        field = ReferenceField(shape, 0, torch.device("cpu"))
        field.reconstructing = reconstructing
        workspace = Workspace(field, capacity)
        made = [plan(workspace, merged=True) for plan in (plans.forward, plans.viewing)]
        made += [plan(workspace) for plan in (plans.backward, plans.density)]
        made += [plans.update(workspace, name) for name in workspace.modules]
        for launch in chain.from_iterable(made):
            if isinstance(launch, Launch):
                constants, _, attributes = _specialised(launch)
                told = [launch.kernel.fn.__name__, *map(str, constants.values())]
                told.append("".join("a" if (i,) in attributes else "-" for i in range(len(launch.arguments))))
                found.setdefault(" ".join(told), launch)
    return found


def _specialised(launch: Launch) -> tuple[dict[str, Any], dict[str, str], dict[tuple[int], Any]]:
    """Constants, types and what is known of the arguments, as a launch would tell the compiler.

    Triton does so by the values: a pointer or number that 16 divides, and the number one.
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
        # The allocator aligns what it gives; a slice begins where it begins.
        begins = value.storage_offset() * value.element_size() if tensor else value
        if begins % ALIGNED == 0:
            attributes[(i,)] = [["tt.divisibility", ALIGNED]]
    return constants, signature, attributes


def compiled(launch: Launch, capability: int) -> Usage:
    """What a kernel takes, compiled for a compute capability."""
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
    for capability in [int(argument) for argument in sys.argv[1:]] or [80, 90]:
        print(f"{f'capability {capability}':60}{'shared':>8}{'registers':>11}{'stack':>8}")
        for told, launch in kernels().items():
            usage = compiled(launch, capability)
            print(f"{told[:59]:60}{usage.shared:>8}{usage.registers:>11}{usage.stack:>8}", flush=True)


if __name__ == "__main__":
    main()
