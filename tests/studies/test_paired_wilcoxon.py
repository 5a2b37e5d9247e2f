"""The paired test against numbers worked out by hand and against scipy."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import wilcoxon

from biresnerf.studies.tables import paired_wilcoxon


def test_ranks_of_a_case_worked_by_hand():
    # Differences -1 +2 -3 -4 -5: the ranks of the one rise sum to 2; of the 32 signs of 5 ranks, the sums
    # 0, 1 and 2 come up once each, on either side: p = 6 / 32.
    test = paired_wilcoxon([10, 10, 10, 10, 10], [9, 12, 7, 6, 5])
    assert (test.pairs, test.differing) == (5, 5)
    assert test.statistic == 2
    assert test.p_value == pytest.approx(6 / 32)
    assert test.median_difference == -3


def test_many_pairs_give_what_scipy_gives():
    random = np.random.default_rng(0)
    first, other = random.normal(size=24), random.normal(0.3, 1, size=24)
    expected = wilcoxon(first, other)
    test = paired_wilcoxon(first, other)
    assert test.statistic == expected.statistic
    assert test.p_value == pytest.approx(expected.pvalue)


def test_pairs_without_difference_are_left_out_and_counted():
    test = paired_wilcoxon([1, 2, 3, 4], [1, 3, 5, 7])
    assert (test.pairs, test.differing) == (4, 3)
    assert test.p_value == pytest.approx(2 / 8)


def test_no_difference_at_all_is_no_test_and_no_pairs_no_result():
    test = paired_wilcoxon([1, 2], [1, 2])
    assert (test.statistic, test.p_value, test.median_difference) == (None, None, 0)
    assert paired_wilcoxon([], []) is None
