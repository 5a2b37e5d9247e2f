"""When a failed request is sent again, and after how long."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, TypeAlias

from biresnerf.client.errors import ServiceError

_PAUSE_S, _LONGEST_PAUSE_S = 0.5, 8.0
# "always": the request may arrive twice; "undone": only if the service certainly did nothing with it.
Again: TypeAlias = Literal["always", "undone"]


@dataclass
class RetryPolicy:
    """What all requests of one client share.

    Attributes:
        patience_s: how long a failing operation is retried.
        on_pause: called with the error and the seconds until the next try.
        answered: whether the service has answered before. If it never has, the address is most likely wrong.
    """

    patience_s: float
    on_pause: Callable[[ServiceError, float], object] | None = None
    answered: bool = False


class Retries:
    """The retries of one operation: growing pauses, or the pause that the service asks for."""

    def __init__(self, policy: RetryPolicy) -> None:
        self._policy = policy
        self._failing_since: float | None = None
        self._pause_s = _PAUSE_S

    def progressed(self) -> None:
        """Starts over, after some progress."""
        self._failing_since, self._pause_s = None, _PAUSE_S

    def pause_after(self, error: ServiceError, *, again: Again = "always") -> float:
        """Seconds to wait before the next try; raises the error if there should be none."""
        now = time.monotonic()
        self._failing_since = self._failing_since or now
        pause_s = self._pause_s if error.retry_after_s is None else error.retry_after_s
        worthwhile = error.retryable and (again == "always" or error.undone)
        if error.code == "unreachable" and not self._policy.answered:
            worthwhile = False
        if not worthwhile or now - self._failing_since + pause_s > self._policy.patience_s:
            raise error
        self._pause_s = min(2 * self._pause_s, _LONGEST_PAUSE_S)
        if self._policy.on_pause is not None:
            self._policy.on_pause(error, pause_s)
        return pause_s
