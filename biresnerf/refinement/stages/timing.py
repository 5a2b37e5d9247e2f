"""When to show a preview of the stages."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Literal

StageName = Literal["coarse", "fine"]
Part = Literal["adjusting", "evaluating", "judging"]

FIRST_PREVIEW_S, PREVIEW_PERIOD_S = 3.0, 20.0
PREVIEW_SHARE = 0.05  # of the run's time, at most


class PreviewTimer:
    """Says when a preview is due: soon after the start, then every so often, but never for much of the time.

    Args:
        period_s: seconds from one to the next, `PREVIEW_PERIOD_S` at most.
    """

    def __init__(self, period_s: float) -> None:
        self._period_s, self._due = min(period_s, PREVIEW_PERIOD_S), 0.0

    def begin(self) -> None:
        """The run steps from now on."""
        self._due = time.monotonic() + min(FIRST_PREVIEW_S, self._period_s)

    @property
    def due(self) -> bool:
        return time.monotonic() >= self._due

    @contextmanager
    def showing(self) -> Iterator[None]:
        """Around the writing of a preview: the longer it takes, the later comes the next."""
        started = time.monotonic()
        yield
        now = time.monotonic()
        self._due = now + max(self._period_s, (now - started) / PREVIEW_SHARE)
