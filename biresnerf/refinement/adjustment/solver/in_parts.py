"""A kernel on all threads of the run, each with its own part of the items."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from itertools import pairwise
from typing import TypeVar

import numba
import numpy as np

Result = TypeVar("Result")


def in_parts(kernel: Callable[[slice], Result], items: int) -> list[Result]:
    """The results of a kernel that releases Python's lock, run on equal parts of the items, in order."""
    workers = numba.get_num_threads()
    bounds = np.linspace(0, items, workers + 1).astype(int)
    parts = (slice(*ends) for ends in pairwise(bounds))
    return list(map(kernel, parts) if workers == 1 else _threads(workers).map(kernel, parts))


@cache  # to begin threads takes longer than a part of a small set
def _threads(workers: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(workers)
