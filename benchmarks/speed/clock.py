"""Times competitors in turn: a shared machine's speed drifts, but the ratio within a round does not."""

from __future__ import annotations

import os
import statistics
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

Clock = Callable[[], float]
CLOCKS: dict[str, Clock] = {"wall": time.perf_counter, "cpu": time.process_time}


def interleave(
    competitors: dict[str, Callable[[], Any]], rounds: int, clock: Clock, warm: int = 1
) -> dict[str, list[float]]:
    """Seconds of each competitor in each round.

    Each runs `warm` times first, and once unmeasured in every round: thread pools sleep while another one runs.
    """
    for run in competitors.values():
        for _ in range(warm):
            run()
    seconds: dict[str, list[float]] = {name: [] for name in competitors}
    for _ in range(rounds):
        for name, run in competitors.items():
            run()
            started = clock()
            run()
            seconds[name].append(clock() - started)
    return seconds


def summary(seconds: list[float]) -> dict[str, float]:
    return {"median_ms": 1e3 * statistics.median(seconds), "min_ms": 1e3 * min(seconds)}


def ratio(slow: list[float], fast: list[float]) -> float:
    """The median of the rounds' ratios."""
    return statistics.median(s / f for s, f in zip(slow, fast, strict=True))


@contextmanager
def timed(functions: list[tuple[Any, str, str]], clock: Clock) -> Iterator[dict[str, float]]:
    """Within this context, adds up the seconds spent in each (owner, attribute, label) under its label."""
    spent = {label: 0.0 for _, _, label in functions}
    kept = [(owner, name, getattr(owner, name)) for owner, name, _ in functions]

    def wrapped(function: Callable[..., Any], label: str) -> Callable[..., Any]:
        def measured(*arguments: Any, **named: Any) -> Any:
            started = clock()
            try:
                return function(*arguments, **named)
            finally:
                spent[label] += clock() - started

        return measured

    for (owner, name, label), (_, _, function) in zip(functions, kept, strict=True):
        setattr(owner, name, wrapped(function, label))
    try:
        yield spent
    finally:
        for owner, name, function in kept:
            setattr(owner, name, function)


@contextmanager
def peak_memory() -> Iterator[dict[str, float]]:
    """`added_mib`: the most this process's memory grew within the context, sampled every 2 ms."""
    result, done = {"added_mib": 0.0}, threading.Event()
    before = resident_mib()

    def watch() -> None:
        while not done.wait(0.002):
            result["added_mib"] = max(result["added_mib"], resident_mib() - before)

    watcher = threading.Thread(target=watch)
    watcher.start()
    try:
        yield result
    finally:
        done.set()
        watcher.join()


def resident_mib() -> float:
    """Memory of this process now."""
    with open("/proc/self/statm") as file:
        return int(file.read().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 2**20
