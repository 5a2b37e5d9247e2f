"""Which views are kept from a field, by the run and by the verdict."""

from __future__ import annotations

import numpy as np
import pytest

from biresnerf.refinement.numbers.choosing import ViewNumbers
from biresnerf.refinement.views.held_out_views import held_out_views, unseen_rounds, unseen_views

VIEWED = ViewNumbers()


@pytest.mark.parametrize("count", [1, 2, 3, 5, 6, 10, 47, 100, 1000])
@pytest.mark.parametrize("asked", ["auto", 0, 1, 7, 200])
def test_held_out_views_are_distinct_indices_and_leave_three_to_learn_from(count, asked):
    views = held_out_views(count, asked, VIEWED)
    assert views == sorted(set(views))
    assert all(0 <= view < count for view in views)
    assert not views or count - len(views) >= 3
    if asked != "auto":
        assert len(views) == max(0, min(asked, count - 3))


def test_a_tenth_is_held_out_by_default_at_most_ten_and_none_of_a_few():
    counts = {5: 0, 6: 1, 25: 2, 100: 10, 1000: 10}
    assert {n: len(held_out_views(n, "auto", VIEWED)) for n in counts} == counts


def test_held_out_views_are_spread_evenly():
    gaps = np.diff([-5, *held_out_views(100, 10, VIEWED), 105])
    assert gaps.min() >= 9
    assert gaps.max() <= 11


def test_views_whose_own_pose_is_doubtful_are_not_held_out():
    sound = np.ones(11, dtype=bool)
    assert held_out_views(11, "auto", VIEWED, sound) == held_out_views(11, "auto", VIEWED) == [5]
    sound[5] = False
    (view,) = held_out_views(11, "auto", VIEWED, sound)
    assert view in (4, 6)
    assert not {5} & set(held_out_views(11, 8, VIEWED, sound))
    assert held_out_views(11, "auto", VIEWED, np.zeros(11, dtype=bool)) == [5], "nothing better: any will do"


def test_unseen_views_hold_those_never_trained_on_and_spare_enough():
    for count in range(4, 120):
        held_out = [1] if count > 5 else []
        views = unseen_views(count, held_out, VIEWED)
        assert set(held_out) <= set(views) < set(range(count))
        assert len(views) == len(set(views)) <= max(1, min(16, count // 3))
    assert len(unseen_views(100, list(range(0, 100, 10)), VIEWED)) == 16
    assert unseen_views(30, list(range(12)), VIEWED) == list(range(12))


@pytest.mark.parametrize("count", range(1, 40))
def test_small_sets_are_looked_at_in_rounds_until_enough_views_were_unseen_or_all(count):
    held_out = held_out_views(count, "auto", VIEWED)
    rounds = unseen_rounds(count, held_out, VIEWED)
    assert rounds[0] == unseen_views(count, held_out, VIEWED)
    seen = [view for views in rounds for view in views]
    assert len(seen) == len(set(seen)), "no view counts twice"
    assert all(len(views) <= max(1, count // 3) for views in rounds), "two thirds are left to learn from"
    if len(rounds[0]) >= 8 or not rounds[0]:
        assert len(rounds) == 1
    elif count >= 9:
        assert len(seen) >= 8
