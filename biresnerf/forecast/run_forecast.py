"""How much of a run is done and how long the rest takes: amounts of work, and the seconds that each takes here.

Rates are measured as the run goes; `biresnerf.forecast.rates` remembers them for the next one on the same machine.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Literal

Phase = Literal[
    "features", "matching", "mapping", "trying", "coarse", "fine", "adjusting", "checking", "evaluating", "judging"
]  # fmt: skip
Unit = Literal[
    "megapixel", "compared feature", "mapped feature", "trial step", "coarse step", "fine step", "adjustment",
    "evaluation",
]  # fmt: skip
UNITS: dict[Phase, Unit] = {
    "features": "megapixel",
    "matching": "compared feature",
    "mapping": "mapped feature",
    "trying": "trial step",
    "coarse": "coarse step",
    "fine": "fine step",
    "adjusting": "adjustment",
    "checking": "trial step",
    "evaluating": "evaluation",
    "judging": "trial step",
}
# Seconds of one core of an AMD EPYC (Zen 4) on some of lego at 100 px, temple, fountain-P11 and fox: where nothing was
# measured yet.
RATES: dict[Unit, float] = {
    "megapixel": 1.1,
    "compared feature": 13.5,  # a million of one photo, with all of another
    "mapped feature": 0.053,  # a thousand
    "trial step": 0.0125,
    "coarse step": 0.015,
    "fine step": 0.0155,
    "adjustment": 0.05,
    "evaluation": 2.4,
}
MEMORY = 0.98  # of the running mean of a step's time
TELLING_S = 2.0  # in less time a small set mostly measures what does not grow with the work
# Of the lightest step that says something about other work: a lighter one mostly takes what does not grow with it.
TELLING_WEIGHT = 0.5
LATE = 0.2  # a phase that takes longer than expected is expected to take this share of its time more
BUSY, BUSY_S = (
    0.67,
    30.0,
)  # share of the processor time it could use that a run got in the last seconds, at most


class Forecast:
    """The time left of a run.

    Attributes:
        rates: seconds of each unit of work.
        left: amount of work in each phase, in its unit; phases that are over or will not be are not in it.
        step_weights: units of work in a step of either stage.
        share: the share of the requested steps that will be taken.
    """

    def __init__(
        self,
        rates: Mapping[Unit, float] = RATES,
        processor_share: Callable[[float, float], float] = lambda _began, _ended: 1.0,
    ) -> None:
        """Expect the rates of an idle machine; ``processor_share`` is `ProcessorShare.between`."""
        self.rates, self._expected = dict(rates), dict(rates)
        self._share = processor_share
        self.left: dict[Phase, float] = {}
        self.step_weights: dict[Phase, float] = {"coarse": 1.0, "fine": 1.0}
        self.share = 1.0
        self._slower = 1.0  # than expected, by the last steps, or before them by what was measured
        self._earlier_s, self._began = 0.0, time.monotonic()
        self._phase: Phase | None = None
        self._phase_began = self._done = 0.0
        self._later = 0.0  # amount of the phase that is done after other phases
        self._steps: dict[Unit, int] = {}
        self._measured: dict[Unit, float] = {}  # seconds that each rate was measured over
        self._when: dict[Unit, tuple[float, float]] = {}  # from when to when
        self._fraction = 0.0

    def plan(self, step_weights: Mapping[Phase, float], share: float) -> None:
        """Set the units of work in a step of either stage, and the share of the requested steps that will be taken."""
        self.step_weights, self.share = dict(step_weights), share

    def expect(self, amounts: Mapping[Phase, float], *, alone: bool = False) -> None:
        """Set the work left in these phases, and in others to nothing if ``alone``."""
        self.left = dict(amounts) if alone else {**self.left, **amounts}

    def pauses(self, seconds: float) -> None:
        """Exclude seconds such as those of compiling kernels from the run: the next run will not need them."""
        self._began += seconds

    def continues(self, seconds: float) -> None:
        """Set how long the run took before it was interrupted."""
        self._earlier_s = seconds

    @contextmanager
    def within(self, phase: Phase, amount: float | None = None) -> Iterator[None]:
        """The context of ``amount`` of a phase, by default all that is left. Its rate is measured at the end."""
        amount = self.left.get(phase, 0.0) if amount is None else amount
        later = max(0.0, self.left.get(phase, 0.0) - amount)
        self.left[phase] = amount
        self.enter(phase)
        self._later = later
        try:
            yield
            self.leave()
            self.left[phase] = later
        finally:
            self._phase, self._later = None, 0.0

    def enter(self, phase: Phase) -> None:
        """Begin a phase, which ends the one before."""
        if phase != self._phase:
            self.leave()
            self._phase, self._phase_began, self._done = phase, time.monotonic(), 0.0

    def took(self, amount: float) -> None:
        """Correct the amount of work of the phase, which ends now."""
        if self._phase is not None:
            self.left[self._phase] = amount

    def leave(self) -> None:
        """End the phase and measure its rate."""
        if self._phase is None:
            return
        amount = self.left.pop(self._phase, 0.0)
        if amount > 0:
            unit, now = UNITS[self._phase], time.monotonic()
            seconds = now - self._phase_began
            self.rates[unit] = seconds / amount
            self._measured[unit] = seconds
            self._when[unit] = self._phase_began, now
            if not self._steps:
                self._slower = self._slower_so_far()
        self._phase = None

    def _slower_so_far(self) -> float:
        """Seconds taken over seconds expected, for all that was measured long enough."""
        told = {unit: s for unit, s in self._measured.items() if s >= TELLING_S}
        expected = sum(s * self._expected[unit] / self.rates[unit] for unit, s in told.items())
        return sum(told.values()) / expected if told else 1.0

    def advance(self, share: float) -> None:
        """Set the share of the phase that is done."""
        self._done = min(1.0, max(0.0, share))

    def stepped(self, stage: Literal["coarse", "fine"], seconds: float) -> None:
        """Add the time of one step. The first of a stage does not count: kernels may be compiled in it.

        Work not measured yet is expected to be slower than predicted by the same factor as the steps; before them, by
        that of all measured work.
        """
        unit = UNITS[stage]
        before = self._steps.get(unit, 0)
        self._steps[unit] = before + 1
        if before == 0:
            self._when[unit] = time.monotonic(), time.monotonic()
            return
        self._when[unit] = self._when[unit][0], time.monotonic()
        share, weight = max(1 / before, 1 - MEMORY), self.step_weights[stage]
        self.rates[unit] += share * (seconds / weight - self.rates[unit])
        self._measured[unit] = self._measured.get(unit, 0.0) + seconds
        if weight >= TELLING_WEIGHT:
            self._slower = self.rates[unit] / self._expected[unit]

    def plan_steps(self, coarse: int, fine: int) -> None:
        """Set how many steps of either stage are left."""
        self.left["coarse"] = coarse * self.step_weights["coarse"]
        self.left["fine"] = fine * self.step_weights["fine"]

    def seconds(self, phase: Phase) -> float:
        """The seconds that the rest of a phase is expected to take."""
        amount = self.left.get(phase, 0.0)
        expected = amount * self._rate(UNITS[phase])
        if phase != self._phase or amount == 0:
            return expected
        elapsed = time.monotonic() - self._phase_began
        later = self._later / amount * max(expected, elapsed)  # no faster than this part of the phase
        if self._done == 0:
            return later + max(expected - elapsed, LATE * elapsed)
        todo = 1 - self._done  # from what was expected to what is measured
        return later + todo * (elapsed + todo * expected)

    def left_s(self, instead: Mapping[Phase, float] | None = None) -> float:
        """Seconds to the end; with other amounts of work in some phases, if given."""
        changed = instead or {}
        return sum(self.seconds(phase) for phase in self.left if phase not in changed) + sum(
            amount * self._rate(UNITS[phase]) for phase, amount in changed.items()
        )

    def now(self) -> tuple[float, float | None]:
        """Fraction of the whole run that is done, which never falls, and seconds left, if any work is known."""
        if not self.left:
            return self._fraction, None
        left_s = self.left_s()
        spent_s = self._earlier_s + time.monotonic() - self._began
        self._fraction = max(self._fraction, min(0.99, spent_s / max(spent_s + left_s, 1e-9)))
        return self._fraction, left_s

    def machine_is_busy(self) -> bool:
        """Whether others took much of the processor in the last seconds, so that the run is slower than it could be."""
        now = time.monotonic()
        return self._share(now - BUSY_S, now) < BUSY

    def measured(self, least_s: float = 0.0) -> dict[Unit, float]:
        """The rates that this run measured over at least so many seconds, converted to an idle machine.

        Steps too light to be representative are left out.
        """
        found: dict[Unit, float] = {}
        for unit, seconds in self._measured.items():
            rate = self.rates[unit]
            if unit in self._steps:
                weight = next(w for stage, w in self.step_weights.items() if UNITS[stage] == unit)
                if weight < TELLING_WEIGHT:
                    continue
                rate = seconds / (self._steps[unit] - 1) / weight  # of all, as the share of the processor is
            if seconds >= least_s:
                found[unit] = rate * self._share(*self._when[unit])
        return found

    def _rate(self, unit: Unit) -> float:
        return self.rates[unit] * (1.0 if unit in self._measured else self._slower)
