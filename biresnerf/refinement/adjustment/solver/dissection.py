"""The order in which cameras and lenses are eliminated: nested dissection (George 1973), as a tree of fronts."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from biresnerf.data.points.tracks import components
from biresnerf.refinement.adjustment.kernels.blocks import steps_from

Parts = NDArray[np.int64]

ONE_FRONT = 100  # so few parts are eliminated at once, as a dense matrix
LEAF = 32  # so few are not parted any more
# Of all parts: what is tied to more is eliminated last, as a lens that most cameras share.
TIED_TO_MANY = 0.25
CUTS = np.linspace(0.35, 0.65, 7)  # shares of the parts on one side
MOST_BETWEEN = 0.4  # of the parts: a larger separator leaves nothing to gain


@dataclass(frozen=True, eq=False)
class Front:
    """Parts that are eliminated together.

    Attributes:
        own: these parts.
        around: later ones that they, or what was eliminated into them, are tied to.
        parent: the front that takes what they leave; -1 for the last one.
        blocks: of the matrix, that enter here; `rows` and `columns` say where among own and around.
    """

    own: Parts
    around: Parts
    parent: int
    blocks: Parts
    rows: Parts
    columns: Parts


def fronts_of(begin: Parts, other: Parts) -> tuple[Front, ...]:
    """The fronts of such blocks (`Blocks`) in order.

    The last has the separator of the largest group of parts, and what most are tied to.
    """
    return _fronts(begin.tobytes(), other.tobytes())


@lru_cache(maxsize=4)  # the same for all steps of an adjustment
def _fronts(begin_bytes: bytes, other_bytes: bytes) -> tuple[Front, ...]:
    begin, other = (np.frombuffer(each, np.int64) for each in (begin_bytes, other_bytes))
    count = len(begin) - 1
    rows = np.repeat(np.arange(count), np.diff(begin))
    owns = _dissected(count, rows, other)
    front_of = np.empty(count, np.int64)
    for number, own in enumerate(owns):
        front_of[own] = number
    enters = np.minimum(front_of[rows], front_of[other])
    by_front = np.split(
        np.argsort(enters, kind="stable"), np.searchsorted(np.sort(enters), np.arange(1, len(owns)))
    )
    left: list[list[Parts]] = [[] for _ in owns]
    place, found = np.empty(count, np.int64), []
    for number, (own, blocks) in enumerate(zip(owns, by_front, strict=True)):
        tied = np.unique(np.concatenate([rows[blocks], other[blocks], *left[number]]))
        around = tied[front_of[tied] > number]
        parent = int(front_of[around].min(initial=len(owns) - 1)) if number < len(owns) - 1 else -1
        left[parent].append(around)
        here = np.concatenate([own, around])
        place[here] = np.arange(len(here))
        found.append(Front(own, around, parent, blocks, place[rows[blocks]], place[other[blocks]]))
    return tuple(found)


def _dissected(count: int, rows: Parts, columns: Parts) -> list[Parts]:
    """The parts of each front, in order."""
    if count <= ONE_FRONT:
        return [np.arange(count)]
    apart = rows != columns
    pairs = rows[apart], columns[apart]
    hubs = np.bincount(np.concatenate(pairs), minlength=count) > TIED_TO_MANY * count
    fronts = list[Parts]()
    _dissect(np.flatnonzero(~hubs), np.zeros(count, np.bool_), pairs, fronts)
    last = [np.flatnonzero(hubs), *fronts[-1:]]
    return [*fronts[:-1], np.concatenate(last)]


def _dissect(
    parts: Parts, inside: NDArray[np.bool_], pairs: tuple[Parts, Parts], fronts: list[Parts]
) -> None:
    """Append fronts of the parts: of each group that hangs together, its smaller side, its larger one, what is between.

    Small groups share a front.
    """
    inside[parts] = True
    among = inside[pairs[0]] & inside[pairs[1]]
    inside[parts] = False
    ours = pairs[0][among], pairs[1][among]
    small: list[Parts] = []
    for group in _groups(parts, components(len(inside), *ours)[parts]):
        sides = None if len(group) <= LEAF else _sides(group, len(inside), ours)
        if sides is None:
            small.append(group)
        if small and (sides is not None or sum(map(len, small)) > LEAF):
            fronts.append(np.concatenate(small))
            small.clear()
        if sides is not None:
            for side in sorted(sides[:2], key=len):
                _dissect(side, inside, ours, fronts)
            fronts.append(sides[2])
    if small:
        fronts.append(np.concatenate(small))


def _groups(parts: Parts, label: Parts) -> list[Parts]:
    """Parts with the same label; the largest group last."""
    order = np.argsort(label, kind="stable")
    found = np.split(parts[order], np.flatnonzero(np.diff(label[order])) + 1)
    return sorted((group for group in found if len(group)), key=len)


def _sides(parts: Parts, count: int, pairs: tuple[Parts, Parts]) -> tuple[Parts, Parts, Parts] | None:
    """Two sides with no ties between them, and their separator; None where that is most of the parts.

    All parts hang together. They are ordered by how much nearer they are, in ties, to one end than to the other.
    """
    both = np.concatenate([pairs[0], pairs[1]]), np.concatenate([pairs[1], pairs[0]])
    order = np.argsort(both[0], kind="stable")
    begin, other = np.searchsorted(both[0][order], np.arange(count + 1)), both[1][order]
    first = steps_from(parts[0], begin, other)
    one = steps_from(parts[np.argmax(first[parts])], begin, other)
    two = steps_from(parts[np.argmax(one[parts])], begin, other)
    ordered = parts[np.argsort((one - two)[parts], kind="stable")]
    best = None
    for share in CUTS:
        low = np.zeros(count, np.bool_)
        low[ordered[: int(share * len(parts))]] = True
        cut = low[pairs[0]] != low[pairs[1]]
        ends = np.concatenate([pairs[0][cut], pairs[1][cut]])
        for between in (np.unique(ends[low[ends]]), np.unique(ends[~low[ends]])):
            if best is None or len(between) < len(best[2]):
                rest = np.setdiff1d(parts, between, assume_unique=True)
                best = rest[low[rest]], rest[~low[rest]], between
    return best if best is not None and len(best[2]) <= MOST_BETWEEN * len(parts) else None
