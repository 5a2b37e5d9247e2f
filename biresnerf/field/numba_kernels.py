"""`njit` and `prange`, which all kernels import from here: Numba reads its target once, when it meets its first kernel.

A process whose first kernel came from elsewhere would compile all of them again, for a target that no cache holds.
"""

from __future__ import annotations

import llvmlite.binding
from numba import njit, prange
from numba.core import config

__all__ = ["njit", "prange"]

# LLVM avoids 512-bit registers by default; the field's kernels are long enough streams to gain from them.
# NUMBA_CPU_NAME, which the tests set for an older processor, takes precedence.
if config.CPU_NAME is None:  # type: ignore[attr-defined]
    config.CPU_NAME = llvmlite.binding.get_host_cpu_name()  # type: ignore[attr-defined]
    config.CPU_FEATURES = llvmlite.binding.get_host_cpu_features().flatten() + ",-prefer-256-bit"  # type: ignore[attr-defined]
