"""When workers that are silent count as dead: not before the living have had time for a heartbeat."""

from __future__ import annotations

import pytest

from workers.queue import janitor as module
from workers.queue.janitor import Janitor
from workers.settings.settings import Settings

STALL_S = 60.0


class Clock:
    """The time that janitors read."""

    def __init__(self) -> None:
        self.now = 1000.0

    def monotonic(self) -> float:
        return self.now


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    clock = Clock()
    monkeypatch.setattr(module, "time", clock)
    return clock


def janitor() -> Janitor:
    settings = Settings(database_url="postgresql://nowhere", stall_s=STALL_S, janitor_s=5.0)
    return Janitor(None, None, settings)  # type: ignore[arg-type]  # asks neither database nor store here


def judges(one: Janitor, clock: Clock, after_s: float, *, database_age_s: float = 1e6) -> bool:
    """Whether silent workers are dead to a round so long after the one before."""
    clock.now += after_s
    one._note_pause(clock.now)
    if one._healthy_since is None:
        one._healthy_since = clock.now
    return one._silent_workers_are_dead(database_age_s)


def test_a_new_janitor_of_an_old_database_judges_at_once_and_of_a_new_one_later(clock: Clock):
    assert judges(janitor(), clock, 0.0)
    assert not judges(janitor(), clock, 0.0, database_age_s=1.4 * STALL_S)
    assert judges(janitor(), clock, 0.0, database_age_s=1.6 * STALL_S)


@pytest.mark.parametrize("slept_s", [0.6 * STALL_S, 10 * STALL_S])
def test_after_a_machine_slept_the_living_have_one_and_a_half_stall_times_for_a_heartbeat(
    clock: Clock, slept_s: float
):
    one = janitor()
    assert judges(one, clock, 0.0)
    assert judges(one, clock, 5.0 + 0.4 * STALL_S), "a round that was a little late is no sleep"
    assert not judges(one, clock, 5.0 + slept_s)
    waited = 0.0
    while not judges(one, clock, 5.0):
        waited += 5.0
    assert 1.4 * STALL_S < waited < 1.6 * STALL_S


def test_an_outage_of_the_database_is_nobodys_silence(clock: Clock):
    one = janitor()
    assert judges(one, clock, 0.0)
    one._healthy_since, one._saw_outage = None, True  # as after a round that could not reach it
    assert not judges(one, clock, 5.0)
    assert not judges(one, clock, 5.0, database_age_s=1e6)
