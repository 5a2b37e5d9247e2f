"""What the machine can do at most, measured: random table accesses and multiply-adds."""

from __future__ import annotations

import platform
from pathlib import Path

import numpy as np
import torch

from benchmarks.speed.clock import Clock
from biresnerf.field.cpu.matrix_blocks import BLOCK, STRIDE, product
from biresnerf.field.numba_kernels import njit, prange

ACCESSES = 1 << 22
REPEATS = 400


@njit(parallel=True, fastmath=True)
def _gather(table, workers):
    """Read 8-byte words at pseudorandom places; the sum keeps the reads alive."""
    found = np.zeros(workers, np.uint64)
    for worker in prange(workers):
        total, state = np.uint64(0), np.uint32(977 * worker + 1)
        for _ in range(ACCESSES // workers):
            state = np.uint32(state * np.uint32(747796405) + np.uint32(2891336453))
            word = np.uint32(np.uint32(state ^ (state >> np.uint32(15))) * np.uint32(277803737))
            total += table[(np.uint64(word) * np.uint64(table.shape[0])) >> np.uint64(32)]
        found[worker] = total
    return found


@njit(parallel=True)
def _products(weight, x, y, workers):
    for worker in prange(workers):
        for _ in range(REPEATS):
            product(weight, x[worker], y[worker], 64, 64, BLOCK)


def limits(threads: int, clock: Clock, table_bytes: int) -> dict[str, float]:
    """Best of several: random 8-byte reads a second from a table of this size, GFLOP/s in float32."""

    def best(run) -> float:
        run()
        seconds = []
        for _ in range(7):
            started = clock()
            run()
            seconds.append(clock() - started)
        return min(seconds)

    table = np.arange(table_bytes // 8, dtype=np.uint64)
    gather = best(lambda: _gather(table, threads))
    weight = np.ones(64 * 64, np.float32)
    x, y = np.ones((threads, 64 * STRIDE), np.float32), np.empty((threads, 64 * STRIDE), np.float32)
    tile = best(lambda: _products(weight, x, y, threads))
    torch.set_num_threads(threads)
    a = torch.ones(1024, 1024)
    library = best(lambda: a @ a)
    torch.set_num_threads(1)
    tile_gflops = 2e-9 * 64 * 64 * BLOCK * REPEATS * threads / tile
    return {
        "random_reads_per_s": ACCESSES / gather,
        "gflops": max(tile_gflops, 2e-9 * 1024**3 / library),
        "gflops_of_torch": 2e-9 * 1024**3 / library,
    }


def describe(threads: int) -> dict[str, str | int]:
    """The machine in words."""
    model = ""
    cpu = Path("/proc/cpuinfo")
    if cpu.exists():
        names = [
            line.split(":", 1)[1].strip() for line in cpu.read_text().splitlines() if "model name" in line
        ]
        model = names[0] if names else ""
    return {"cpu": model, "platform": platform.platform(), "threads": threads, "torch": torch.__version__}
