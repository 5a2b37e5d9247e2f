"""When to show how far a run is: soon after its start, then every so often, and never for much of its time."""

from __future__ import annotations

import time
from collections.abc import Callable

FIRST_S, PERIOD_S = 3.0, 20.0
SHARE = 0.05  # of the run's time, at most


class Previews:
    """Takes previews of one run.

    Args:
        show: writes a preview and returns its files.
        period_s: seconds from one to the next, `PERIOD_S` at most.
    """

    def __init__(self, show: Callable[[], tuple[str, ...]], period_s: float) -> None:
        self._show, self._period_s = show, min(period_s, PERIOD_S)
        self._due = 0.0

    def begin(self) -> None:
        """The run steps from now on."""
        self._due = time.monotonic() + min(FIRST_S, self._period_s)

    def if_due(self) -> tuple[str, ...]:
        """The files of a preview just written, if it was time for one."""
        return self.take() if time.monotonic() >= self._due else ()

    def take(self) -> tuple[str, ...]:
        """The files of a preview just written."""
        started = time.monotonic()
        files = self._show()
        now = time.monotonic()
        self._due = now + max(self._period_s, (now - started) / SHARE)
        return files
