"""The share of its usable processor time that a run got; other programs on the machine take the rest.

Linux counts for each thread how long it ran and how long it waited for a core. Elsewhere the share is unknown and
assumed to be 1.
"""

from __future__ import annotations

import os
import threading
import time
from bisect import bisect_left, bisect_right
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

LOOK_EVERY_S = 1.0
LEAST_S = 0.2  # of work in an interval; with less, a waiting time of milliseconds would count


class ProcessorShare:
    """Watches this process and its children, while used as a context."""

    def __init__(self) -> None:
        self._threads: dict[
            tuple[str, str], tuple[float, float]
        ] = {}  # latest figures, of those that ended as well
        self._moments: list[float] = []
        self._sums: list[tuple[float, float]] = []

    def between(self, began: float, ended: float) -> float:
        """The share from one moment to another, both of `time.monotonic`: at most 1, and 1 where nothing ran."""
        if len(self._moments) < 2:
            return 1.0
        first = max(0, bisect_right(self._moments, began) - 1)
        last = min(len(self._moments) - 1, bisect_left(self._moments, ended))
        ran, waited = (b - a for a, b in zip(self._sums[first], self._sums[last], strict=True))
        return ran / (ran + waited) if ran + waited >= LEAST_S else 1.0

    def look(self) -> None:
        """Add up how long all threads have run and waited so far."""
        now = time.monotonic()
        for place, figures in _figures(str(os.getpid())):
            self._threads[place] = figures
        self._moments.append(now)
        self._sums.append(
            (sum(ran for ran, _ in self._threads.values()), sum(w for _, w in self._threads.values()))
        )

    @contextmanager
    def watching(self) -> Iterator[None]:
        """Call `look` repeatedly: the figures of a child that ends are lost."""
        ended = threading.Event()

        def watch() -> None:
            self.look()
            while not ended.wait(LOOK_EVERY_S):
                self.look()

        watcher = threading.Thread(target=watch, name="processor share", daemon=True)
        watcher.start()
        try:
            yield
        finally:
            ended.set()
            watcher.join()
            self.look()


def _figures(process: str) -> Iterator[tuple[tuple[str, str], tuple[float, float]]]:
    """For each thread of a process and its children: seconds on a core, and seconds of waiting for one."""
    try:
        threads = list(Path("/proc", process, "task").iterdir())
    except OSError:  # it has ended, or the system has no such files
        return
    for thread in threads:
        try:
            ran, waited, _ = (thread / "schedstat").read_text("ascii").split()
            children = (thread / "children").read_text("ascii").split()
        except OSError:
            continue
        yield (process, thread.name), (int(ran) / 1e9, int(waited) / 1e9)
        for child in children:
            yield from _figures(child)
