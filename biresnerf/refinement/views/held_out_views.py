"""Which views are left out of a training: to be scored at the end, or to compare two sets of poses."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import numpy as np

from biresnerf.refinement.numbers.choosing import ViewNumbers


def evenly_spread(views: Sequence[int], count: int) -> list[int]:
    """``count`` of the views (at most all), in their order and evenly spread."""
    return [views[int((i + 0.5) * len(views) / count)] for i in range(count)]


def held_out_views(
    count: int,
    asked: int | Literal["auto"],
    numbers: ViewNumbers,
    reliable: np.ndarray | None = None,
) -> list[int]:
    """Indices of the views kept from the field, evenly spread.

    Args:
        count: all views.
        asked: how many are wanted; auto: a tenth, at most 10, and none of fewer than 6.
        reliable: bool [count], views to choose from, where there are any: a view with a doubtful pose proves nothing.
    """
    some = max(1, min(numbers.hold_out_most, count // numbers.hold_out_one_in))
    usual = 0 if count < numbers.hold_out_from else some
    wanted = usual if asked == "auto" else asked
    among = np.arange(count) if reliable is None or not reliable.any() else np.flatnonzero(reliable)
    return evenly_spread(among.tolist(), min(wanted, max(0, count - 3), len(among)))


def unseen_views(count: int, held_out: Sequence[int], numbers: ViewNumbers) -> list[int]:
    """The views that the verdict is based on: those held out by the refinement, and others, evenly spread.

    `most_unseen` in all, unless more are held out; at least `least_views` where no more than a third of all are needed.
    """
    spared = count // numbers.spared_of
    wanted = min(numbers.most_unseen, max(spared // 2, min(numbers.least_views, spared)))
    others = [i for i in range(count) if i not in set(held_out)]
    more = max(0, wanted - len(held_out))
    return sorted({*held_out, *evenly_spread(others, more)})


def unseen_rounds(count: int, held_out: Sequence[int], numbers: ViewNumbers) -> list[list[int]]:
    """The views that each pair of trainings leaves out: one round, or in small sets others as well, none twice."""
    rounds = [unseen_views(count, held_out, numbers)]
    while rounds[0] and len(rounds) < numbers.rounds_most and sum(map(len, rounds)) < numbers.enough_views:
        left = sorted(set(range(count)) - {view for views in rounds for view in views})
        size = min(len(rounds[0]), len(left))
        if size == 0:
            break
        rounds.append(evenly_spread(left, size))
    return rounds
