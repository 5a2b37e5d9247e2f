"""The CUDA kernels compile, also for arguments that are not aligned, and fit a GPU's resources."""

from __future__ import annotations

import os
import re
import subprocess
import sys

import pytest

pytest.importorskip("triton", minversion="3.6", reason="what kernels take is known for Triton 3.6 and later")

pytestmark = pytest.mark.slow

CAPABILITY = 90
SPILLS = {"colour_backward": 128, "density_backward": 64}  # bytes of a thread; no other kernel may spill
# The table that the sine of a large angle is reduced by lies on the stack, too.
SINE = {"move": 48, "move_backward": 48, "directions": 48}
SHARED = 99 * 1024  # bytes of a block, on the smallest GPU that is supported (compute capability 8.6)


@pytest.fixture(scope="module")
def table():
    """Name with constants, alignment of the arguments, shared memory, registers and stack, of each kernel.

    From a process of its own: in this one, the interpreter has taken the compiler's place.
    """
    environment = {key: value for key, value in os.environ.items() if key != "TRITON_INTERPRET"}
    command = [sys.executable, "-m", "benchmarks.gpu.compile_cuda", str(CAPABILITY)]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=500, check=False)
    if "cuobjdump" in done.stderr and "No such file" in done.stderr:
        pytest.skip("this Triton has no cuobjdump, which says what kernels take")
    assert done.returncode == 0, done.stderr
    return re.findall(r"^(.+) ([a-]+) +(\d+) +(\d+) +(\d+)$", done.stdout, re.MULTILINE)


def test_no_kernel_spills_more_than_it_did_or_needs_more_memory_than_a_gpu_has(table):
    assert {name.split()[0] for name, *_ in table} > {"march", "encode", "composite", *SPILLS, *SINE}
    for name, _, shared, _, stack in table:
        assert int(stack) <= (SPILLS | SINE).get(name.split()[0], 0), name
        assert int(shared) <= SHARED, name


def test_slices_of_buffers_are_compiled_as_what_they_are(table):
    """Controls lie side by side, four bytes each: 16 divides the address of every fourth of them alone."""
    marching = [aligned for name, aligned, *_ in table if name.startswith("march ")]
    assert len(marching) >= 2
    assert all("-" in each and "a" in each for each in marching)
