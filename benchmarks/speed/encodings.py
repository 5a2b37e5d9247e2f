"""The two encodings alone: forward with Jacobian, gradient to positions, table gradient with Adam."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

from benchmarks.speed.clock import Clock, interleave, ratio, summary
from benchmarks.speed.torch_forms import encode_unrolled, encode_vectorised
from benchmarks.speed.yardstick import Yardstick, build_yardstick, check_yardstick
from biresnerf.field.cpu import encoding
from biresnerf.field.cpu.field import tasks
from biresnerf.field.cpu.segments_backward import add_position_gradient
from biresnerf.field.grid_levels import GridLevels, grid_levels
from biresnerf.field.numba_kernels import njit, prange
from biresnerf.field.reference import operations as reference

GRIDS = {
    "pose-estimation module": grid_levels(3, 16, 72, 22),
    "reconstruction module": grid_levels(16, 128, 4096, 19),
}
PER_RAY, SPACING = 32, 3**0.5 / 1024
PIECE = 1024
ADAM = np.array([1e-4, 0.9, 0.99, 1e-15, 1.5, 1.2], np.float32)


def points_along_rays(count: int) -> np.ndarray:
    """Runs of 32 neighbouring samples across a shell [count, 3], as after pruning."""
    rng = np.random.default_rng(0)
    rays = count // PER_RAY

    def unit(vectors: np.ndarray) -> np.ndarray:
        return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)

    normal, direction = unit(rng.normal(size=(rays, 3))), unit(rng.normal(size=(rays, 3)))
    hit = 0.5 + normal * rng.uniform(0.3, 0.35, (rays, 1))
    t = (np.arange(PER_RAY) - PER_RAY / 2 + rng.uniform(size=(rays, 1))) * SPACING
    return (
        (hit[:, None] + direction[:, None] * t[..., None])
        .reshape(-1, 3)
        .clip(1e-3, 1 - 1e-3)
        .astype(np.float32)
    )


@njit(parallel=True)
def _position_gradient(g, jacobian, dx):
    n = jacobian.shape[2]
    for piece in prange((n + PIECE - 1) // PIECE):
        begin = piece * PIECE
        count = min(PIECE, n - begin)
        held, total = np.empty(g.shape[0] * PIECE, np.float32), np.zeros(3 * PIECE, np.float32)
        for row in range(g.shape[0]):
            held[row * PIECE : row * PIECE + count] = g[row, begin : begin + count]
        add_position_gradient(held, 0, PIECE, jacobian, begin, count, np.float32(1), total)
        for axis in range(3):
            dx[axis, begin : begin + count] = total[axis * PIECE : axis * PIECE + count]


class Kernels:
    """Our encodings under the yardstick's names."""

    def __init__(self, grid: GridLevels, threads: int) -> None:
        self.grid, self.threads = grid, threads
        self._scratch = np.zeros((threads, 2 * int(np.diff(grid.offset).max())), np.float32)
        self._rates = np.full(grid.levels, ADAM[0])

    def encode(self, x: np.ndarray, table: np.ndarray, features: np.ndarray, jacobian: np.ndarray) -> None:
        grid = self.grid
        words = table.reshape(-1).view(np.uint64)
        encoding.encode(
            x, words, grid.scale, grid.stride, grid.hashed, grid.offset, np.float32(0), features, jacobian
        )

    def position_gradient(self, g: np.ndarray, jacobian: np.ndarray, dx: np.ndarray) -> None:
        _position_gradient(g, jacobian, dx)

    def update_table(
        self, x: np.ndarray, g: np.ndarray, table: np.ndarray, moments: list[np.ndarray], adam: np.ndarray
    ) -> None:
        grid = self.grid
        begin, end = np.zeros(1, np.int64), np.array([len(x) // 3])
        encoding.update_table(
            x, begin, end, g, grid.scale, grid.stride, grid.hashed, grid.offset, table.reshape(-1),
            moments[0].reshape(-1), moments[1].reshape(-1), self._rates, tuple(adam[1:]), self._scratch, tasks(),
            self.threads,
        )  # fmt: skip


def _torch_form(encode, grid: GridLevels, x: np.ndarray, table: np.ndarray, g: np.ndarray):
    points, entries = torch.from_numpy(x).requires_grad_(), torch.from_numpy(table.copy()).requires_grad_()
    upstream = torch.from_numpy(np.ascontiguousarray(g.T))

    def run() -> None:
        points.grad = entries.grad = None
        encode(points, entries, grid).backward(upstream)

    return run


def _all_operations(one, x: np.ndarray, table: np.ndarray, g: np.ndarray):
    grid, n = one.grid, len(x)
    features, jacobian = np.empty((grid.width, n), np.float32), np.empty((grid.levels, 6, n), np.float32)
    dx, moments = np.empty((3, n), np.float32), [np.zeros_like(table), np.zeros_like(table)]
    flat, entries = x.reshape(-1), table.copy()
    return {
        "forward": lambda: one.encode(flat, entries, features, jacobian),
        "position gradient": lambda: one.position_gradient(g, jacobian, dx),
        "table gradient and Adam": lambda: one.update_table(flat, g, entries, moments, ADAM),
    }


def run(
    samples: int, rounds: int, threads: int, clock: Clock, limit: dict[str, float]
) -> list[dict[str, Any]]:
    """One row per module; torch's times leave Adam out, ours and the yardstick's hold it."""
    library = build_yardstick()
    x, rows = points_along_rays(samples), []
    for name, grid in GRIDS.items():
        rng = np.random.default_rng(1)
        table = rng.uniform(-0.1, 0.1, (grid.entries, 2)).astype(np.float32)
        g = rng.normal(size=(grid.width, len(x))).astype(np.float32)
        parts = {"kernels": _all_operations(Kernels(grid, threads), x, table, g)}
        if library is not None:
            check_yardstick(library, grid)
            parts["C++"] = _all_operations(Yardstick(library, grid, threads), x, table, g)
        competitors = {
            f"{who}: {what}": operation for who, held in parts.items() for what, operation in held.items()
        }
        fast = interleave(competitors, rounds, clock)
        torch.set_num_threads(threads)
        forms = {"definition": reference.encode, "vectorised": encode_vectorised, "unrolled": encode_unrolled}
        slow = interleave(
            {form: _torch_form(encode, grid, x, table, g) for form, encode in forms.items()},
            max(1, rounds // 3),
            clock,
        )
        torch.set_num_threads(1)

        def total(who: str, held=fast) -> list[float]:
            columns = [v for k, v in held.items() if k.startswith(who)]
            return [sum(values) for values in zip(*columns, strict=True)]

        ours = total("kernels")
        best = float(np.median(ours))
        reads = 8 * grid.levels * len(x) / np.median(fast["kernels: forward"])
        row = {
            "module": name, "samples": len(x), "kernels": summary(ours), "ns_per_sample": 1e9 * best / len(x),
            "parts_ns": {k: 1e9 * float(np.median(v)) / len(x) for k, v in fast.items()},
            "torch_ms": {k: 1e3 * float(np.median(v)) for k, v in slow.items()},
            "times_faster": {k: float(np.median(v)) / best for k, v in slow.items()},
            "share_of_random_reads": float(reads / limit["random_reads_per_s"]),
            "times_the_yardstick": ratio(ours, total("C++")) if library else None,
        }  # fmt: skip
        rows.append(row)
    return rows
