"""The forecast of a run: what its parts will take, as far as that is known."""

import time

import pytest

from biresnerf.refine.stages.timing import Forecast, WorkAhead

STEPS, SWITCH, COARSE_S, FINE_S = 1000, 400, 0.01, 0.02
PARTS = {"adjusting": 500.0, "evaluating": 100.0, "judging": 300.0}
AFTER_S = 900 * FINE_S


def forecast(parts=PARTS) -> Forecast:
    found = Forecast(WorkAhead(parts))
    found.stepped("coarse", COARSE_S)
    found.stepped("fine", FINE_S)
    return found


def left_at(found: Forecast, step: int, **spent: float) -> float:
    return found.at(step, SWITCH, STEPS, {"coarse": 4.0, "fine": 0.0, **spent})[1]


def test_the_steps_and_what_follows_them_are_predicted():
    assert left_at(forecast(), 0) == pytest.approx(400 * COARSE_S + 600 * FINE_S + AFTER_S)
    assert left_at(forecast(), 700) == pytest.approx(300 * FINE_S + AFTER_S)
    assert left_at(forecast({}), STEPS) == 0


def test_what_was_adjusted_on_the_way_is_not_counted_again():
    found = forecast()
    assert left_at(found, STEPS, adjusting=6.0) == pytest.approx(AFTER_S - 6.0)
    assert left_at(found, STEPS, adjusting=60.0) == pytest.approx(400 * FINE_S)


def test_a_part_that_is_over_has_nothing_left_whatever_it_took():
    found = forecast()
    with found.within("judging"):
        assert left_at(found, STEPS) == pytest.approx(300 * FINE_S, abs=0.1)


def test_a_part_on_its_way_is_predicted_by_what_it_has_taken():
    found = forecast({"judging": 10.0})  # 0.2 s are expected
    with found.within("judging"):
        time.sleep(0.4)
        found.done_of_part = 0.5
        assert left_at(found, STEPS) == pytest.approx(0.5 * (0.4 + 0.5 * 0.2), abs=0.1)
        found.done_of_part = 1.0
        assert left_at(found, STEPS) == 0


def test_the_fraction_is_the_time_spent_over_the_whole_and_never_falls():
    found = forecast()
    early = found.at(700, SWITCH, STEPS, {"coarse": 4.0, "fine": 6.0, "preparing": 10.0})[0]
    assert early == pytest.approx(0.03 + 0.96 * 20 / (20 + 6 + AFTER_S))
    found.step_seconds["fine"] *= 10
    assert found.at(700, SWITCH, STEPS, {"coarse": 4.0, "fine": 6.0})[0] == early


def test_the_first_step_counts_only_until_there_is_another_and_later_ones_alike():
    found = Forecast()
    found.stepped("coarse", 5.0)
    assert found.step_seconds["coarse"] == 5.0
    for seconds in (0.1, 0.2, 0.3):
        found.stepped("coarse", seconds)
    assert found.step_seconds == {"coarse": pytest.approx(0.2), "fine": 0.0}
