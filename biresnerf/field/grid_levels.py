"""Geometry of a multiresolution grid: how many vertices each level has and where they lie in its table.

Conventions of tiny-cuda-nn: scale_l = N_min b^l - 1, ceil(scale_l) + 1 vertices a side, and a point x in [0, 1]
sits at scale_l x + 0.5, so that the levels' faces are staggered. A level whose vertices fit the table is stored
densely (x fastest), the others are hashed with x ^ y 2654435761 ^ z 805459861 (Teschner et al. 2003).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np

FEATURES = 2  # per entry, Table 1 of Guo et al. 2023
HASH_PRIMES = (1, 2654435761, 805459861)


@dataclass(frozen=True)
class GridLevels:
    """Layout of all levels of one encoding; entries of level l are ``offset[l]:offset[l + 1]`` of the table."""

    scale: np.ndarray  # float32 [levels]
    stride: np.ndarray  # uint32 [levels], vertices a side of a dense level (one more than reached: no wrap)
    hashed: np.ndarray  # bool [levels]
    offset: np.ndarray  # int64 [levels + 1], in entries

    @cached_property
    def levels(self) -> int:
        return len(self.scale)

    @cached_property
    def entries(self) -> int:
        return int(self.offset[-1])

    @cached_property
    def width(self) -> int:
        """Features of one encoded point."""
        return self.levels * FEATURES


def grid_levels(levels: int, resolution_min: int, resolution_max: int, table_size_log2: int) -> GridLevels:
    """Levels growing geometrically from ``resolution_min`` to ``resolution_max`` cells a side.

    A level needing more than 2**table_size_log2 entries is hashed into that many.
    """
    growth = (resolution_max / resolution_min) ** (1 / (levels - 1)) if levels > 1 else 1.0
    scale = np.array([resolution_min * growth**level - 1 for level in range(levels)], np.float64)
    stride = np.ceil(scale - 1e-9).astype(np.int64) + 2
    dense = stride**3
    table = 1 << table_size_log2
    hashed = dense > table
    # Levels start on a 64-byte line (8 entries), the unit in which the sparse Adam skips untouched memory.
    size = np.where(hashed, table, 8 * np.array([math.ceil(n / 8) for n in dense]))
    offset = np.concatenate([[0], np.cumsum(size)]).astype(np.int64)
    return GridLevels(scale.astype(np.float32), stride.astype(np.uint32), hashed, offset)
