"""The C++ encodings of hashgrid_yardstick.cpp, compiled here and now with the machine's g++ and checked before use."""

from __future__ import annotations

import ctypes
import shutil
import subprocess
import tempfile
from pathlib import Path

import numpy as np
import torch

from biresnerf.field.grid_levels import GridLevels
from biresnerf.field.reference import operations as reference

SOURCE = Path(__file__).with_name("hashgrid_yardstick.cpp")
FLAGS = ["-O3", "-march=native", "-mprefer-vector-width=512", "-ffast-math", "-fopenmp", "-fPIC"]


def _pointer(array: np.ndarray) -> ctypes.c_void_p:
    assert array.flags.c_contiguous
    return ctypes.c_void_p(array.ctypes.data)


class Yardstick:
    """The operations on one grid; arrays as the Numba kernels take them."""

    def __init__(self, library: ctypes.CDLL, grid: GridLevels, threads: int) -> None:
        self._library, self.grid, self.threads = library, grid, threads
        self._hashed = grid.hashed.astype(np.uint8)
        self._levels = ctypes.c_int64(grid.levels)
        self._largest = int(np.diff(grid.offset).max())
        self._scratch = np.zeros((threads, 2 * self._largest), np.float32)

    def _geometry(self) -> tuple[ctypes.c_void_p, ...]:
        grid = self.grid
        return tuple(_pointer(a) for a in (grid.scale, grid.stride, self._hashed, grid.offset))

    def encode(self, x: np.ndarray, table: np.ndarray, features: np.ndarray, jacobian: np.ndarray) -> None:
        self._library.encode(
            _pointer(x), ctypes.c_int64(len(x) // 3), _pointer(table), *self._geometry(), self._levels,
            _pointer(features), _pointer(jacobian), self.threads,
        )  # fmt: skip

    def position_gradient(self, g: np.ndarray, jacobian: np.ndarray, dx: np.ndarray) -> None:
        self._library.position_gradient(
            _pointer(g),
            _pointer(jacobian),
            self._levels,
            ctypes.c_int64(g.shape[1]),
            _pointer(dx),
            self.threads,
        )

    def update_table(
        self, x: np.ndarray, g: np.ndarray, table: np.ndarray, moments: list[np.ndarray], adam: np.ndarray
    ) -> None:
        self._library.update_table(
            _pointer(x), ctypes.c_int64(len(x) // 3), _pointer(g), *self._geometry(), self._levels, _pointer(table),
            _pointer(moments[0]), _pointer(moments[1]), _pointer(adam), _pointer(self._scratch),
            ctypes.c_int64(self._largest), self.threads,
        )  # fmt: skip


def build_yardstick() -> ctypes.CDLL | None:
    """The compiled library; None where there is no g++."""
    compiler = shutil.which("g++")
    if compiler is None:
        return None
    folder = Path(tempfile.mkdtemp(prefix="biresnerf-yardstick-"))
    try:
        compiled, target = folder / "yardstick.o", folder / "yardstick.so"
        subprocess.run([compiler, *FLAGS, "-c", str(SOURCE), "-o", str(compiled)], check=True)
        # Linked with -ffast-math, it would flush subnormal numbers to zero in the whole process.
        subprocess.run([compiler, "-fopenmp", "-shared", str(compiled), "-o", str(target)], check=True)
        return ctypes.CDLL(str(target))
    finally:
        shutil.rmtree(folder)


def check_yardstick(library: ctypes.CDLL, grid: GridLevels) -> None:
    """Raises AssertionError unless values and all gradients equal the definition's on points of this grid."""
    one = Yardstick(library, grid, 2)
    rng = np.random.default_rng(0)
    n = 1111
    x = rng.uniform(0.01, 0.99, (n, 3)).astype(np.float32)
    table = rng.uniform(-1, 1, (grid.entries, 2)).astype(np.float32)
    g = rng.uniform(-1, 1, (grid.width, n)).astype(np.float32)
    features, jacobian = np.empty((grid.width, n), np.float32), np.empty((grid.levels, 6, n), np.float32)
    points, entries = torch.from_numpy(x).requires_grad_(), torch.from_numpy(table.copy()).requires_grad_()
    expected = reference.encode(points, entries, grid)
    expected.backward(torch.from_numpy(g.T.copy()))
    one.encode(x.reshape(-1), table, features, jacobian)
    np.testing.assert_allclose(features.T, expected.detach().numpy(), atol=2e-3)
    dx = np.empty((3, n), np.float32)
    one.position_gradient(g, jacobian, dx)
    off = np.abs(dx.T - points.grad.numpy()).max(1) > 1e-2 * float(points.grad.abs().max())
    assert off.mean() < 0.02, "gradient to positions"  # but for points on cell faces
    moments = [np.zeros_like(table), np.zeros_like(table)]
    one.update_table(x.reshape(-1), g, table, moments, np.array([0.01, 0.9, 0.99, 1e-15, 10, 10], np.float32))
    np.testing.assert_allclose(10 * moments[0], entries.grad.numpy(), atol=5e-3)
