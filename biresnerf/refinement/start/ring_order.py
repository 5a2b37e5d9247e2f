"""In what order photos were taken around an object, by their names and by how alike they look.

Names give the order within a run of photos that each resemble the next. Where they do not, the table or the camera was
moved, possibly laid on its side: the runs are put together, either way round and turned by quarters, so that the photos
where they meet are most alike.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise, permutations, product

import numpy as np
from numpy.typing import NDArray

from biresnerf.data.photos.area_resize import area_resize
from biresnerf.data.photos.images import ImageSet

SIDE = 24  # px of the squares that photos are compared in
RUNS_MOST = 6  # there are 46,080 closed chains of six runs, before they are turned


@dataclass(frozen=True, eq=False)
class RingOrder:
    """Photos around an object.

    Attributes:
        order: indices [n] of the photos, one after the other around the object; the last is followed by the first.
        quarters: quarter turns [n], counter-clockwise, that set photo i upright as the ring's first is.
        run: number of the run [n] that each photo belongs to.
    """

    order: NDArray[np.int64]
    quarters: NDArray[np.int64]
    run: NDArray[np.int64]


def thumbnails(images: ImageSet) -> NDArray[np.float32]:
    """Photos, 0 to 1, centred in squares of `SIDE` px [n, SIDE, SIDE, 3] with their background around them."""
    small = []
    for i in range(len(images)):
        photo = images.image(i).astype(np.float32) / 255
        height, width = photo.shape[:2]
        side = max(height, width)
        square = np.empty((side, side, 3), dtype=np.float32)
        square[:] = photo.mean((0, 1)) if images.background is None else images.background
        top, left = (side - height) // 2, (side - width) // 2
        square[top : top + height, left : left + width] = photo
        small.append(area_resize(square, min(SIDE, side), min(SIDE, side)))
    return np.stack(small)


def turned_distances(small: NDArray[np.float32]) -> NDArray[np.float64]:
    """Root mean squared difference [n, n, 4] of each photo from every other, turned by 0 to 3 quarters."""
    flat = small.reshape(len(small), -1).astype(np.float64)
    found = []
    for quarter in range(4):
        other = np.rot90(small, quarter, (1, 2)).reshape(len(small), -1).astype(np.float64)
        squared = (flat**2).sum(1)[:, None] + (other**2).sum(1)[None] - 2 * flat @ other.T
        found.append(np.sqrt(np.maximum(squared, 0) / flat.shape[1]))
    return np.stack(found, 2)


def find_ring(images: ImageSet, named: NDArray[np.int64]) -> RingOrder:
    """The photos' order around the object, from that of their names: indices [n] in `named`.

    With more than `RUNS_MOST` runs the order of names is kept: then nothing shows how the runs meet.
    """
    apart = turned_distances(thumbnails(images))
    steps = apart[named[:-1], named[1:], 0]
    # A run ends where a photo differs from the next more like any two do than like neighbours do.
    pairs = apart[:, :, 0][np.triu_indices(len(apart), 1)]
    ends = np.flatnonzero(steps > (np.median(steps) + np.median(pairs)) / 2) + 1
    runs = np.split(named, ends)
    if not 1 < len(runs) <= RUNS_MOST:
        none = np.zeros(len(named), dtype=np.int64)
        return RingOrder(named, none, none)
    return _joined(runs, apart)


def _joined(runs: list[NDArray[np.int64]], apart: NDArray[np.float64]) -> RingOrder:
    """The closed chain of all runs, each either way round, whose ends are most alike where they meet."""
    first, rest = runs[0], runs[1:]
    links = apart.min(2)
    chains = (
        [first, *(rest[i][::way] for i, way in zip(places, ways, strict=True))]
        for places in permutations(range(len(rest)))
        for ways in product((1, -1), repeat=len(rest))
    )
    best = min(chains, key=lambda chain: sum(links[a[-1], b[0]] for a, b in pairwise([*chain, first])))
    quarters = np.zeros(len(apart), dtype=np.int64)
    for before, run in pairwise(best):
        turn = int(apart[before[-1], run[0]].argmin())
        quarters[run] = (quarters[before[-1]] + turn) % 4
    of_run = np.empty(len(apart), dtype=np.int64)
    of_run[np.concatenate(best)] = np.repeat(np.arange(len(best)), [len(run) for run in best])
    return RingOrder(np.concatenate(best), quarters, of_run)


def axis_in_photos(images: ImageSet, ring: RingOrder) -> tuple[int, float]:
    """Where the axis of turning stands: quarter turns that set the ring's first photo upright, 0 or 1, and its place.

    What turns sweeps a body of revolution, so the mean of all photos is nearly symmetric about the axis.

    Returns:
        the place is right of the middle of the photos set upright, in their long sides.
    """
    small = thumbnails(images)
    mean = np.mean([np.rot90(small[i], quarter) for i, quarter in enumerate(ring.quarters)], 0)
    seen = mean - (mean[:1, :1] if images.background is None else images.background)
    side = seen.shape[0]
    shifts = range(-(side // 4), side // 4 + 1)  # of twice the axis's place
    scores = {}
    for quarter in (0, 1):
        upright = np.rot90(seen, quarter)
        for shift in shifts:
            here = upright[:, max(0, shift) : side + min(0, shift)]
            scores[quarter, shift] = float((here * here[:, ::-1]).sum() / (upright**2).sum())
    quarter, shift = max(scores, key=lambda key: scores[key])
    return quarter, shift / 2 / side
