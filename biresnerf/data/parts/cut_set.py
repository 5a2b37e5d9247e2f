"""Cut a set into parts that overlap, each to be refined by itself, on as many machines as there are."""

from __future__ import annotations

from collections import defaultdict

import numpy as np
from numpy.typing import NDArray

from biresnerf.data.model.dataset import Dataset
from biresnerf.data.seeding.map_images import likely_pairs
from biresnerf.errors import InputError

PHOTOS = 400  # of a part
SHARED = 0.2  # of a part's photos, that another part has as its own
FEWEST = 20  # photos of a part


def cut_set(dataset: Dataset, most: int = PHOTOS) -> tuple[NDArray[np.int64], ...]:
    """Rows of each part's photos, ascending; every photo is in one part at least.

    METIS cuts the graph of likely pairs where few of them are (Karypis and Kumar, A fast and high quality multilevel
    scheme for partitioning irregular graphs, SIAM Journal on Scientific Computing 1998). Pairs count by the neighbours
    that both photos have. Each part then takes photos of the others, those that hang together with it most.

    Args:
        most: about how many photos a part has, shared ones included.

    Raises:
        InputError: ``invalid_options`` for parts that are too small; ``extra_missing``.
    """
    if most < FEWEST:
        raise InputError(
            "invalid_options", f"a part of {most} photos is too small.", where="most",
            hint=f"Name {FEWEST} or more.",
        )  # fmt: skip
    count = int(np.ceil(len(dataset) / (most * (1 - SHARED)))) if len(dataset) > most else 1
    if count == 1:
        return (np.arange(len(dataset)),)
    weights = _weights(likely_pairs(dataset), len(dataset))
    own = _metis(weights, count)
    borrowed = round(most * SHARED)
    parts = []
    for part in range(count):
        near: defaultdict[int, int] = defaultdict(int)
        for row in np.flatnonzero(own == part).tolist():
            for other, weight in weights[row].items():
                if own[other] != part:
                    near[other] += weight
        nearest = sorted(near, key=lambda row: (-near[row], row))[:borrowed]
        parts.append(np.sort(np.concatenate([np.flatnonzero(own == part), np.array(nearest, np.int64)])))
    return tuple(part for part in parts if len(part))


def _weights(pairs: set[tuple[int, int]], count: int) -> list[dict[int, int]]:
    """For each photo, those that it makes a pair with, and one more than the neighbours that the two share."""
    near: list[set[int]] = [set() for _ in range(count)]
    for a, b in pairs:
        near[a].add(b)
        near[b].add(a)
    return [{b: 1 + len(near[a] & near[b]) for b in sorted(near[a])} for a in range(count)]


def _metis(weights: list[dict[int, int]], count: int) -> NDArray[np.int64]:
    """The part of each photo."""
    try:
        import pymetis
    except ImportError as error:
        raise InputError(
            "extra_missing",
            "cutting a set needs pymetis.",
            where="pymetis",
            hint='Run `pip install "biresnerf[colmap]"`.',
        ) from error
    near = [list(row) for row in weights]
    of_pairs = [weight for row in weights for weight in row.values()]
    return np.array(pymetis.part_graph(count, adjacency=near, eweights=of_pairs)[1], np.int64)
