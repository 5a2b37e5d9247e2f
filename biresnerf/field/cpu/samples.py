"""The samples of a batch of rays, and how they are cut into segments."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from biresnerf.field.cpu.vector_access import KERNEL
from biresnerf.field.numba_kernels import njit

SEGMENT, MOST_SEGMENTS = 1024, 64  # samples of a segment, until that makes too many


class Composited(NamedTuple):
    """What compositing n samples leaves for the backward pass. Values of `colour` are of the kept samples."""

    outputs: np.ndarray  # [16 n]
    density: np.ndarray  # [n]
    alpha: np.ndarray  # [n]
    kept: np.ndarray  # [n]
    kept_begin: np.ndarray  # [rays]
    kept_end: np.ndarray  # [rays]
    colour: np.ndarray  # [3 n]


@dataclass(frozen=True)
class Samples:
    """What the forward pass leaves for the backward pass; arrays are views of `Buffers`.

    Rays segment[s]:segment[s + 1] form segment s; `learning` segments give gradients to the field. Of the samples of
    ray r, offset[r]:offset[r + 1], light reaches those with indices kept[kept_begin[r]:kept_end[r]]. There were
    `marched` samples before any were merged. `weights` are those of the networks' layers.
    """

    segment: np.ndarray
    learning: int
    offset: np.ndarray
    x: np.ndarray
    t: np.ndarray
    dt: np.ndarray
    ray: np.ndarray
    marched: int
    features: np.ndarray
    jacobians: list[np.ndarray]
    composited: Composited
    weights: tuple[np.ndarray, ...]


def segments(offset: np.ndarray, trained: int) -> tuple[np.ndarray, int]:
    """Runs of whole rays with about `SEGMENT` samples each, as first rays [segments + 1], and how many are trained.

    No run holds rays of both kinds. What is cut where depends on the rays alone, not on the number of threads.
    """
    cuts, counts = np.empty(2 * MOST_SEGMENTS + 3, np.int64), np.zeros(2, np.int64)
    size = max(SEGMENT, -(-int(offset[-1]) // MOST_SEGMENTS))
    _cut(offset, trained, size, cuts, counts)
    learning, of_all = counts.tolist()
    return cuts[: of_all + 1], learning


@njit(**KERNEL)
def _cut(offset, trained, size, cuts, counts):
    """Fill `cuts` from its start, and counts [2] with how many segments are trained, and of all."""
    cuts[0] = 0
    for kind in range(2):
        begin, end = (0, trained) if kind == 0 else (trained, offset.shape[0] - 1)
        if kind == 1:
            counts[1] = counts[0]
        if begin >= end:
            continue
        goal = offset[begin] + size
        for r in range(begin + 1, end):
            if goal < offset[end] and offset[r] >= goal:
                counts[kind] += 1
                cuts[counts[kind]] = r
                goal += (offset[r] - goal) // size * size + size
        counts[kind] += 1
        cuts[counts[kind]] = end
