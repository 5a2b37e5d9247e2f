"""The comparison: intervals and findings are those of Student's test, with its rate of false findings."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import t as student
from scipy.stats import ttest_1samp

from biresnerf.judging import compare as rules
from biresnerf.judging.compare import Rule, compare, is_better, octaves, paired, student_quantile

ROOT = Path(__file__).resolve().parents[2]
OPPOSITE = {"better": "worse", "worse": "better", "same": "same", "open": "open"}
BY_CHANCE = [
    rules.UNSEEN_PSNR,
    rules.UNSEEN_SSIM,
    rules.MATCH_ERRORS,
    rules.LEFT_OUT,
    Rule(least=0.2, beyond=0.3),
]
SINGLE = [
    rules.LATER_MATCH_ERRORS, rules.MEASURED, rules.TRIAL, rules.CLEAR_TRIAL, rules.FACING_FORWARD, rules.REPAIRED,
]  # fmt: skip


@pytest.mark.parametrize("freedom", [1, 2, 5, 15, 30, 31, 60, 500])
def test_the_quantile_is_students(freedom):
    assert student_quantile(freedom) == pytest.approx(student.ppf(0.975, freedom), rel=2e-3)


@pytest.mark.parametrize("rule", BY_CHANCE)
@pytest.mark.parametrize("count", [3, 8, 40])
def test_interval_and_finding_are_those_of_students_test(rule, count):
    rng = np.random.default_rng(count)
    scale = max(rule.least, 0.05)
    seen = set()
    for mean in np.linspace(-4, 4, 81) * scale:
        gains = mean + rng.normal(0, scale, count)
        found, tested = compare(gains, rule), ttest_1samp(gains, 0)
        low, high = tested.confidence_interval(0.95)
        assert (found.low, found.high) == pytest.approx((low, high), rel=0.01, abs=5e-3 * scale)
        edges = np.abs(
            [low - rule.beyond, high + rule.beyond, low + 1.5 * rule.least, high - 1.5 * rule.least]
        )
        if min(edges) < 0.02 * scale:
            continue
        above = ttest_1samp(gains, rule.beyond).pvalue < 0.05 and gains.mean() > rule.beyond
        below = ttest_1samp(gains, -rule.beyond).pvalue < 0.05 and gains.mean() < -rule.beyond
        within = -1.5 * rule.least <= low and high <= 1.5 * rule.least
        expected = "same" if within else "open"
        if above and gains.mean() >= rule.least:
            expected = "better"
        elif below and gains.mean() <= -rule.least:
            expected = "worse"
        assert found.finding == expected
        seen.add(expected)
    assert {"better", "worse"} < seen


@pytest.mark.parametrize("rule", [*BY_CHANCE, rules.FREER_LENS, rules.READING])
@pytest.mark.parametrize("seed", range(10))
def test_swapping_the_two_sets_turns_every_finding_round(rule, seed):
    rng = np.random.default_rng(seed)
    before, after = rng.normal(20, 1, (2, rng.integers(1, 12))) * rule.least + rng.normal(0, 1, (2, 1))
    forth, back = paired(before, after, rule), paired(after, before, rule)
    assert back.difference == pytest.approx(-forth.difference)
    if forth.low is not None:
        assert (back.low, back.high) == (pytest.approx(-forth.high), pytest.approx(-forth.low))
    assert back.finding == OPPOSITE[forth.finding]


@pytest.mark.parametrize(
    ("rule", "count", "share"),
    [
        (Rule(), 10, 0.025),
        (rules.LEFT_OUT, 5, 0.025),
        (rules.FREER_LENS, 10, student.sf(2.0, 9)),
        (Rule(errors=1.0), 4, student.sf(1.0, 3)),
    ],
)
def test_chance_alone_is_taken_for_a_gain_as_often_as_the_rule_says(rule, count, share):
    noise = np.random.default_rng(5).normal(0, 2.0, (4000, count))
    said = [compare(gains, rule).finding for gains in noise]
    expected = pytest.approx(share, abs=4 * (share / 4000) ** 0.5)
    assert (said.count("better") / 4000, said.count("worse") / 4000) == (expected, expected)


def test_intervals_hold_the_true_gain_nineteen_times_in_twenty():
    gains = np.random.default_rng(6).normal(0.7, 1.5, (4000, 6))
    held = sum(low <= 0.7 <= high for _, low, high, _ in (compare(each, Rule()) for each in gains))
    assert held / 4000 == pytest.approx(0.95, abs=0.014)


@pytest.mark.parametrize("rule", SINGLE)
def test_where_chance_has_no_say_the_least_gain_decides(rule):
    said = [compare(share * rule.least, rule).finding for share in (1.01, 0.99, 0.0, -0.99, -1.01)]
    assert said == ["better", "same", "same", "same", "worse"]
    assert is_better(rule.least, rule)


def test_any_gain_is_one_of_any_size_but_none():
    assert [compare(gain, rules.ANY_GAIN).finding for gain in (1e-12, 0.0, -1e-12)] == [
        "better",
        "same",
        "worse",
    ]


@pytest.mark.parametrize(
    ("count", "rule"), [(1, rules.UNSEEN_PSNR), (2, rules.LEFT_OUT), (0, rules.LEFT_OUT)]
)
def test_too_few_gains_leave_it_open(count, rule):
    assert compare(np.full(count, 5.0), rule)[1:] == (None, None, "open")
    assert (
        compare(np.full(count + 2, 5.0) + 0.01 * np.arange(count + 2), replace(rule, fewest=1)).finding
        == "better"
    )


def test_what_is_not_known_speaks_for_nothing():
    for rule in (*BY_CHANCE, *SINGLE, rules.ANY_GAIN):
        assert compare(np.array([1.0, np.nan, 2.0]), rule).finding == "open"


def test_a_gain_has_to_matter_however_certain_it_is():
    sure = 0.49 + 1e-4 * np.resize([1.0, -1.0], 50)
    assert compare(sure, rules.UNSEEN_PSNR).finding == "same"
    assert compare(sure + 0.02, rules.UNSEEN_PSNR).finding == "better"


def test_an_interval_has_to_lie_beyond_what_is_asked():
    gains = 1.0 + 0.1 * np.resize([1.0, -1.0], 10)  # give or take 0.075
    assert [compare(gains, Rule(beyond=b)).finding for b in (0.9, 0.95)] == ["better", "open"]
    assert [compare(-gains, Rule(beyond=b)).finding for b in (0.9, 0.95)] == ["worse", "open"]


def test_octaves_count_halvings_and_take_tiny_errors_for_equal():
    assert octaves(np.array([8.0, 1.0, 0.01]), np.array([2.0, 4.0, 0.04]), 0.05).tolist() == [2.0, -2.0, 0.0]


def test_a_report_has_the_figures_of_both_sets():
    found = paired(np.array([4.0, 8.0]), np.array([1.0, 2.0]), rules.MATCH_ERRORS, gains=np.array([2.0, 2.0]))
    assert (found.count, found.before, found.after, found.difference) == (2, 6.0, 1.5, 2.0)
    assert (found.low, found.high, found.finding) == (2.0, 2.0, "better")


def test_no_other_place_makes_an_interval():
    sources = (path for path in (ROOT / "biresnerf").rglob("*.py") if "ddof=1" in path.read_text())
    assert [path.relative_to(ROOT).as_posix() for path in sources] == ["biresnerf/judging/compare.py"]


def test_the_page_on_the_verdict_names_every_rule_among_the_judges():
    page = (ROOT / "docs/verdict.md").read_text()
    judges = page[page.index("### All judges") : page.index("## How far to trust it")]
    named = set(re.findall(r"`([A-Z_]+)`", judges))
    assert named == {name for name, value in vars(rules).items() if isinstance(value, Rule)}
