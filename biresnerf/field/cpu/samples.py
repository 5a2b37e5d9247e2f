"""The samples of a batch of rays, and how they are cut into segments."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

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
    marched: int
    offset: np.ndarray
    x: np.ndarray
    t: np.ndarray
    dt: np.ndarray
    ray: np.ndarray
    features: np.ndarray
    jacobians: list[np.ndarray]
    composited: Composited
    weights: tuple[np.ndarray, ...]


def segments(offset: np.ndarray, trained: int) -> tuple[np.ndarray, int]:
    """Runs of whole rays with about `SEGMENT` samples each, as first rays [segments + 1], and how many are trained.

    No run holds rays of both kinds. What is cut where depends on the rays alone, not on the number of threads.
    """
    rays = len(offset) - 1
    size = max(SEGMENT, -(-int(offset[-1]) // MOST_SEGMENTS))
    cuts, learning = [0], 0
    for begin, end in ((0, trained), (trained, rays)):
        if begin < end:
            goals = np.arange(offset[begin] + size, offset[end], size)
            inside = np.unique(np.searchsorted(offset[begin:end], goals)) + begin
            cuts += [int(cut) for cut in inside if begin < cut < end] + [end]
        if end == trained:
            learning = len(cuts) - 1
    return np.array(cuts, np.int64), learning
