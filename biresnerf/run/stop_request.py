"""Signals that ask a run to end: it writes a checkpoint and a partial result first."""

from __future__ import annotations

import logging
import signal
import sys
import threading
from types import FrameType, TracebackType
from typing import Any

logger = logging.getLogger(__name__)


class StopRequest:
    """Set by the given signals; a second one ends the process, or in a notebook the cell, at once.

    To be used in a `with` block, at whose end the signals do what they did before. Outside the main thread Python
    handles no signals, so nothing is changed there.

    Attributes:
        signal: the number of the signal that came; None so far.
    """

    def __init__(self, *signals: signal.Signals) -> None:
        self.signal: int | None = None
        self._signals = signals
        self._before: dict[signal.Signals, Any] = {}

    def __enter__(self) -> StopRequest:
        if threading.current_thread() is threading.main_thread():
            self._before = {number: signal.signal(number, self._on_signal) for number in self._signals}
        return self

    def __exit__(
        self, _kind: type[BaseException] | None, _error: BaseException | None, _trace: TracebackType | None
    ) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)

    def _on_signal(self, number: int, _frame: FrameType | None) -> None:
        if self.signal is None:
            self.signal = number
            logger.warning("stopping: writing checkpoint and partial result …")
        elif number == signal.SIGINT:
            raise KeyboardInterrupt
        else:
            sys.exit(128 + number)

    def __call__(self) -> bool:
        return self.signal is not None
