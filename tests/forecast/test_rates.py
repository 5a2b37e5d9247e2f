"""What a machine remembers of its runs' speed, and what it predicts by that."""

import json

import pytest

from biresnerf.forecast.rates import (
    CREDIBLE,
    RATES_FILE,
    UNKNOWN,
    cache_folder,
    latest_machine,
    machine_rates,
    remember_rates,
)
from biresnerf.forecast.run_forecast import RATES

USUAL = RATES["coarse step"] / 2  # of two threads


@pytest.fixture(autouse=True)
def cache(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    return tmp_path


def test_a_machine_remembers_what_its_runs_measured():
    assert machine_rates("cpu", 2).seconds == {unit: rate / 2 for unit, rate in RATES.items()}
    remember_rates("cpu", 2, {"coarse step": 1.2 * USUAL})
    known = machine_rates("cpu", 2)
    assert known.seconds["coarse step"] == pytest.approx(1.2 * USUAL)
    assert known.seconds["mapped feature"] == RATES["mapped feature"] / 2
    assert known.measured == {"coarse step"}
    assert machine_rates("cpu", 3).measured == set(), "each number of threads is a machine of its own"
    assert machine_rates("cuda", 2).measured == set()


def test_one_strange_run_among_others_changes_nothing():
    for factor in (1.2, 1.2, 2.9, 1.2):
        remember_rates("cpu", 2, {"coarse step": factor * USUAL})
    assert machine_rates("cpu", 2).seconds["coarse step"] == pytest.approx(1.2 * USUAL)


def test_of_two_runs_the_faster_one_is_believed_and_of_many_the_latest():
    for factor in (2.0, 1.5):
        remember_rates("cpu", 2, {"coarse step": factor * USUAL})
    assert machine_rates("cpu", 2).seconds["coarse step"] == pytest.approx(1.5 * USUAL)
    for _ in range(5):
        remember_rates("cpu", 2, {"coarse step": 0.8 * USUAL})
    assert machine_rates("cpu", 2).seconds["coarse step"] == pytest.approx(0.8 * USUAL)


@pytest.mark.parametrize(("factor", "believed"), [(380.0, CREDIBLE), (0.001, 1 / CREDIBLE)])
def test_no_memory_moves_a_prediction_further_than_threefold(factor: float, believed: float):
    remember_rates("cpu", 2, {"coarse step": factor * USUAL})
    assert machine_rates("cpu", 2).seconds["coarse step"] == pytest.approx(believed * USUAL)


def test_a_gpu_may_be_as_fast_as_it_is():
    remember_rates("cuda", 2, {"coarse step": 0.01 * USUAL})
    assert machine_rates("cuda", 2).seconds["coarse step"] == pytest.approx(0.01 * USUAL)


def test_where_rates_were_never_measured_a_range_is_predicted_and_one_number_where_they_were():
    work = {"coarse": 100.0, "evaluating": 3.0}
    usual = 100 * RATES["coarse step"] + 3 * RATES["evaluation"]
    assert machine_rates("cpu", 1).between(work) == pytest.approx((UNKNOWN[0] * usual, UNKNOWN[1] * usual))
    remember_rates("cpu", 1, {"coarse step": RATES["coarse step"]})
    steps, rest = 100 * RATES["coarse step"], 3 * RATES["evaluation"]
    assert machine_rates("cpu", 1).between(work) == pytest.approx(
        (steps + UNKNOWN[0] * rest, steps + UNKNOWN[1] * rest)
    )
    remember_rates("cpu", 1, {"evaluation": RATES["evaluation"]})
    assert machine_rates("cpu", 1).between(work) == pytest.approx((usual, usual))


def test_the_machine_is_that_of_the_latest_run_with_as_many_threads_if_any_had_so_many():
    assert latest_machine(2) == ("cpu", 2)
    remember_rates("cpu", 2, {"coarse step": USUAL})
    remember_rates("cpu", 8, {"coarse step": USUAL})
    assert (latest_machine(2), latest_machine(4)) == (("cpu", 2), ("cpu", 8))
    remember_rates("cuda", 4, {"coarse step": USUAL})
    assert latest_machine(2) == ("cuda", 4)


@pytest.mark.parametrize(
    "text",
    [
        "",
        "{",
        "[]",
        '{"cpu 2": 5}',
        '{"cpu 2": {"coarse step": 0.1}}',
        '{"cpu 2": {"coarse step": ["slow", -1.0, 0.0]}}',
    ],
)
def test_a_damaged_memory_is_none(text):
    (cache_folder() / RATES_FILE).parent.mkdir()
    (cache_folder() / RATES_FILE).write_text(text)
    assert machine_rates("cpu", 2).measured == set()
    remember_rates("cpu", 2, {"coarse step": USUAL})
    assert machine_rates("cpu", 2).measured == {"coarse step"}


def test_a_machine_without_room_for_a_memory_runs_all_the_same(monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", "/proc/none")
    remember_rates("cpu", 2, {"coarse step": USUAL})
    assert machine_rates("cpu", 2).measured == set()


def test_the_memory_does_not_grow():
    for _ in range(20):
        remember_rates("cpu", 2, {"coarse step": USUAL})
    assert len(json.loads((cache_folder() / RATES_FILE).read_text())["cpu 2"]["coarse step"]) == 5
