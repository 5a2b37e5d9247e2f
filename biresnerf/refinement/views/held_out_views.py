"""Which views are left out of a training: to be scored at the end, or to compare two sets of poses."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import numpy as np

HOLD_OUT_ONE_IN, HOLD_OUT_MOST, HOLD_OUT_FROM = 10, 10, 6
LEAST_VIEWS = 5  # unseen, where the set is large enough to spare them
SPARED_OF = 3  # and one in so many at most
# Fewer unseen views leave too wide an interval: trainings are repeated with others left out.
ENOUGH_VIEWS, ROUNDS_MOST = 8, 3
MOST_UNSEEN = 16  # of a round


def evenly_spread(views: Sequence[int], count: int) -> list[int]:
    """So many of the views (at most all), in their order and evenly spread."""
    return [views[int((i + 0.5) * len(views) / count)] for i in range(count)]


def held_out_views(count: int, asked: int | Literal["auto"], reliable: np.ndarray | None = None) -> list[int]:
    """Indices of the views kept from the field, evenly spread.

    Args:
        count: all views.
        asked: how many are wanted; auto: a tenth, at most 10, and none of fewer than 6.
        reliable: bool [count], views to choose from, where there are any: a view with a doubtful pose proves nothing.
    """
    usual = 0 if count < HOLD_OUT_FROM else max(1, min(HOLD_OUT_MOST, count // HOLD_OUT_ONE_IN))
    wanted = usual if asked == "auto" else asked
    among = np.arange(count) if reliable is None or not reliable.any() else np.flatnonzero(reliable)
    return evenly_spread(among.tolist(), min(wanted, max(0, count - 3), len(among)))


def unseen_views(count: int, held_out: Sequence[int], most: int) -> list[int]:
    """The views that the verdict is passed on: those held out by the refinement, and others, evenly spread.

    `most` in all, unless more are held out; at least `LEAST_VIEWS` where no more than a third of all are needed.
    """
    wanted = max(len(held_out), min(most, max(count // SPARED_OF // 2, min(LEAST_VIEWS, count // SPARED_OF))))
    others = [i for i in range(count) if i not in set(held_out)]
    more = wanted - len(held_out)
    return sorted({*held_out, *evenly_spread(others, more)})


def unseen_rounds(count: int, held_out: Sequence[int], most: int = MOST_UNSEEN) -> list[list[int]]:
    """The views that each pair of trainings leaves out: one round, or in small sets others as well, none twice."""
    rounds = [unseen_views(count, held_out, most)]
    while rounds[0] and len(rounds) < ROUNDS_MOST and sum(map(len, rounds)) < ENOUGH_VIEWS:
        left = sorted(set(range(count)) - {view for views in rounds for view in views})
        size = min(len(rounds[0]), len(left))
        if size == 0:
            break
        rounds.append(evenly_spread(left, size))
    return rounds
