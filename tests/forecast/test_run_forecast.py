"""The forecast of a run: what its phases will take, as far as that is known."""

from collections.abc import Callable

import pytest

from biresnerf.forecast.run_forecast import BUSY_S, RATES, TELLING_S, Forecast

COARSE_S, FINE_S = 0.01, 0.02
AFTER = {"adjusting": 50.0, "evaluating": 1.0, "judging": 400.0}


def forecast(**left: float) -> Forecast:
    """Of a machine on which everything else takes as long as thought."""
    found = Forecast(RATES | {"coarse step": COARSE_S, "fine step": FINE_S})
    found.left = dict(left)
    return found


@pytest.fixture(autouse=True)
def passes(monkeypatch) -> Callable[[float], None]:
    """Lets so many seconds pass; without it none do."""
    now = [100.0]
    monkeypatch.setattr("biresnerf.forecast.run_forecast.time.monotonic", lambda: now[0])

    def passes(seconds: float) -> None:
        now[0] += seconds

    return passes


def test_the_steps_and_what_follows_them_are_predicted():
    found = forecast(**AFTER)
    found.plan_steps(400, 600)
    after_s = 50 * RATES["adjustment"] + RATES["evaluation"] + 400 * RATES["trial step"]
    assert found.left_s() == pytest.approx(400 * COARSE_S + 600 * FINE_S + after_s)
    found.step_weights = {"coarse": 2.0, "fine": 3.0}
    found.plan_steps(400, 600)
    assert found.left_s() == pytest.approx(2 * 400 * COARSE_S + 3 * 600 * FINE_S + after_s)


def test_other_amounts_of_work_can_be_asked_for():
    found = forecast(**AFTER)
    rest = found.left_s() - found.seconds("judging")
    assert found.left_s({"judging": 100.0}) == pytest.approx(rest + 100 * RATES["trial step"])


def test_a_machine_whose_steps_are_slower_is_thought_slower_in_all_that_was_not_measured(passes):
    found = forecast(judging=400.0)
    for _ in range(2):
        found.stepped("coarse", 3 * COARSE_S)
    assert found.left_s() == pytest.approx(3 * 400 * RATES["trial step"])
    with found.within("trying", 10.0):
        passes(0.1)
    assert found.left_s() == pytest.approx(400 * 0.01)


def test_before_the_steps_a_machine_is_thought_as_slow_as_what_it_has_done(passes):
    found = forecast(features=10.0, matching=1.0, judging=400.0)
    for phase, took_s in (("features", 30 * RATES["megapixel"]), ("matching", TELLING_S / 2)):
        with found.within(phase):
            passes(took_s)
    assert found.left_s() == pytest.approx(3 * 400 * RATES["trial step"]), (
        "but for what took no time to speak of"
    )
    for _ in range(2):
        found.stepped("coarse", 2 * COARSE_S)
    assert found.left_s() == pytest.approx(2 * 400 * RATES["trial step"]), "steps tell more"


def test_a_phase_that_is_over_has_nothing_left_and_teaches_what_the_rest_of_it_will_take(passes):
    found = forecast(adjusting=100.0)
    with found.within("adjusting", 50.0):
        passes(0.2)
    assert found.left["adjusting"] == 50.0
    assert found.left_s() == pytest.approx(0.2)
    with found.within("adjusting", 50.0):
        pass
    assert found.left_s() == 0


def test_while_a_part_of_a_phase_is_done_the_rest_of_it_is_still_to_come(passes):
    part = 0.2 / RATES["adjustment"]
    found = forecast(adjusting=2 * part, judging=10.0)
    all_s = found.left_s()
    with found.within("adjusting", part):
        assert found.left_s() == pytest.approx(all_s)
        found.advance(1.0)
        assert found.seconds("adjusting") == pytest.approx(0.2)
        passes(0.5)
        assert found.seconds("adjusting") == pytest.approx(0.5), "it is as slow as this one"
    assert found.left["adjusting"] == part


def test_a_phase_on_its_way_is_predicted_by_what_it_has_taken(passes):
    found = forecast(judging=0.2 / RATES["trial step"])
    with found.within("judging"):
        passes(0.4)
        found.advance(0.5)
        assert found.left_s() == pytest.approx(0.5 * (0.4 + 0.5 * 0.2))
        found.advance(1.0)
        assert found.left_s() == 0


def test_a_phase_that_was_less_work_than_expected_teaches_the_rate_of_what_it_was(passes):
    found = forecast(judging=400.0)
    with found.within("judging"):
        passes(0.2)
        found.took(100.0)
    assert found.left["judging"] == 0
    assert found.measured()["trial step"] == pytest.approx(0.2 / 100)


def test_a_phase_that_takes_longer_than_expected_is_not_over_yet(passes):
    found = forecast(evaluating=0.1 / RATES["evaluation"])
    with found.within("evaluating"):
        passes(0.5)
        assert found.left_s() == pytest.approx(0.1)


def test_the_phases_of_matching_follow_each_other(passes):
    found = forecast(features=1.0, matching=10.0, mapping=5.0)
    found.enter("features")
    passes(0.2)
    found.enter("matching")
    assert "features" not in found.left
    found.enter("matching")
    found.advance(0.5)
    found.enter("mapping")
    found.leave()
    assert found.left == {}
    assert set(found.measured()) == {"megapixel", "compared feature", "mapped feature"}
    assert found.measured()["megapixel"] == pytest.approx(0.2)


def test_what_took_too_short_a_time_is_not_told_to_the_next_run(passes):
    found = forecast(judging=400.0)
    with found.within("trying", 10.0):
        passes(0.1)
    for _ in range(2):
        found.stepped("coarse", 3.0)
    assert set(found.measured()) == {"trial step", "coarse step"}
    assert set(found.measured(least_s=2.0)) == {"coarse step"}


def test_a_phase_that_ends_with_an_error_teaches_nothing():
    found = forecast(judging=400.0)
    with pytest.raises(RuntimeError), found.within("judging"):
        raise RuntimeError
    assert found.measured() == {}


def test_the_fraction_is_the_time_spent_over_the_whole_and_never_falls():
    found = forecast(judging=10 / RATES["trial step"])
    found.continues(10.0)
    early, left_s = found.now()
    assert (early, left_s) == (pytest.approx(0.5), pytest.approx(10.0))
    found.left["judging"] *= 10
    assert found.now() == (early, pytest.approx(100.0))


def test_nothing_is_predicted_before_any_work_is_known():
    assert Forecast().now() == (0.0, None)


def test_a_first_step_that_compiles_says_nothing_and_later_ones_count_alike():
    found = Forecast()
    found.plan_steps(coarse=100, fine=0)
    expected = found.left_s()
    found.stepped("coarse", 60.0)
    assert found.left_s() == expected
    assert found.measured() == {}
    for seconds in (0.1, 0.2, 0.3):
        found.stepped("coarse", seconds)
    assert found.rates["coarse step"] == pytest.approx(0.2)
    assert set(found.measured()) == {"coarse step"}


def test_time_of_a_pause_is_no_part_of_the_run(monkeypatch):
    clock = [100.0]
    monkeypatch.setattr("biresnerf.forecast.run_forecast.time.monotonic", lambda: clock[0])
    found = Forecast({**RATES, "mapped feature": 1.0})
    clock[0] += 900  # kernels are compiled
    found.pauses(900)
    found.left["mapping"] = 30
    clock[0] += 10
    assert found.now() == (0.25, 30)


def test_a_run_tells_the_next_what_its_work_takes_while_nobody_else_uses_the_machine(passes):
    shares = {(100.0, 110.0): 0.25, (110.0, 118.0): 0.5}
    found = Forecast(RATES, lambda began, ended: shares[began, ended])
    found.left = {"judging": 400.0}
    with found.within("judging"):
        passes(10.0)
    found.stepped("coarse", 60.0)
    for seconds in (2.0, 6.0):
        passes(seconds)
        found.stepped("coarse", seconds)
    assert found.measured() == pytest.approx({"trial step": 0.25 * 10.0 / 400, "coarse step": 0.5 * 4.0})
    assert found.rates["trial step"] == pytest.approx(10.0 / 400), "this run goes on as slowly"


def test_steps_of_little_work_say_nothing_of_larger_ones_or_of_anything_else():
    found = forecast(judging=400.0)
    found.step_weights["coarse"] = 1 / 16
    for _ in range(3):
        found.stepped("coarse", 5.0)
    assert found.seconds("judging") == pytest.approx(400 * RATES["trial step"])
    assert found.measured() == {}
    found.plan_steps(10, 0)
    assert found.seconds("coarse") == pytest.approx(50.0), "but of the steps to come"


@pytest.mark.parametrize(("share", "busy"), [(0.5, True), (0.9, False)])
def test_the_machine_is_busy_where_others_take_much_of_the_processor(passes, share: float, busy: bool):
    asked = []
    found = Forecast(RATES, lambda began, ended: asked.append((began, ended)) or share)
    assert found.machine_is_busy() is busy
    assert asked == [(100.0 - BUSY_S, 100.0)]
