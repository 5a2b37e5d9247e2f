"""Compile every CUDA kernel for compute capabilities, without a GPU: `python -m benchmarks.speed.compile_cuda 80 90`.

The interpreter that runs the kernels in tests is more forgiving than the compiler. Prints what each kernel takes:
shared memory, registers of a thread and what of them is spilt to the stack (bytes).
"""

from __future__ import annotations

import re
import subprocess
import sys
import tempfile
from itertools import chain
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
CUOBJDUMP = Path(triton.__file__).parent / "backends" / "nvidia" / "bin" / "cuobjdump"


def _launches() -> dict[tuple[Any, ...], Launch]:
    """Every kernel with every set of constants it is launched with, at the paper's encodings."""
    found = {}
    for unbounded in (False, True):
        shape = FieldShape(grid_levels(3, 16, 72, 22), grid_levels(16, 128, 4096, 10), unbounded)
        field = ReferenceField(shape, 0, torch.device("cpu"))
        for reconstructing in (False, True):
            field.reconstructing = reconstructing
            workspace = Workspace(field, Capacity(256, 1024, 768, 8))
            made = [plan(workspace) for plan in (plans.forward, plans.viewing, plans.backward, plans.density)]
            made += [plans.update(workspace, name) for name in workspace.modules]
            for launch in chain.from_iterable(made):
                if isinstance(launch, Launch):
                    constants = [launch.arguments[p.name] for p in launch.kernel.params if p.is_constexpr]
                    found.setdefault((launch.kernel.fn.__name__, *constants), launch)
    return found


def _compile(launch: Launch, capability: int) -> str:
    constants, signature, attributes = {}, {}, {}
    for i, parameter in enumerate(launch.kernel.params):
        value = launch.arguments[parameter.name]
        if parameter.is_constexpr:
            constants[parameter.name], signature[parameter.name] = value, "constexpr"
        elif isinstance(value, torch.Tensor):
            signature[parameter.name] = POINTERS[value.dtype]
            attributes[(i,)] = [["tt.divisibility", 16]]
        else:
            signature[parameter.name] = "i32"
    compiled = triton.compile(
        ASTSource(launch.kernel, signature=signature, constexprs=constants, attrs=attributes),
        target=GPUTarget("cuda", capability, 32),
        options={"num_warps": launch.warps, "num_stages": 1},
    )
    with tempfile.NamedTemporaryFile(suffix=".cubin") as file:
        file.write(compiled.asm["cubin"])
        file.flush()
        usage = subprocess.run(
            [CUOBJDUMP, "--dump-resource-usage", file.name], capture_output=True, text=True, check=True
        )
    registers, stack = re.search(r"REG:(\d+) STACK:(\d+)", usage.stdout).groups()
    return f"{compiled.metadata.shared:>8}{registers:>11}{stack:>8}"


def main() -> None:
    launches = _launches()
    for capability in [int(argument) for argument in sys.argv[1:]] or [80, 90]:
        print(f"{f'capability {capability}':48}{'shared':>8}{'registers':>11}{'stack':>8}")
        for (name, *constants), launch in launches.items():
            told = f"{name} {' '.join(str(c) for c in constants)}"
            print(f"{told[:47]:48}{_compile(launch, capability)}", flush=True)


if __name__ == "__main__":
    main()
