"""Rate limits: a token bucket per client, in the memory of each web process.

With n replicas behind a proxy a client may send n times as much. Limits that must be exact (jobs, bytes) are
counted in the database.
"""

from __future__ import annotations

import math
import time
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass

# Beyond this the clients that were silent longest are forgotten; they start again with a full bucket.
CLIENTS_MAX = 10_000


@dataclass(frozen=True)
class Allowance:
    """What a client has left. ``wait_s`` is 0 if the request is allowed, else the seconds until the next one is."""

    policy: str
    limit: int
    remaining: int
    full_in_s: int
    wait_s: int

    def headers(self) -> dict[str, str]:
        """The headers of draft-ietf-httpapi-ratelimit-headers."""
        window_s = max(1, self.full_in_s)
        return {
            "RateLimit-Policy": f'"{self.policy}";q={self.limit}',
            "RateLimit": f'"{self.policy}";r={self.remaining};t={window_s}',
        }


class Buckets:
    """A bucket of ``burst`` tokens for each client, refilled at ``rate`` a second; a request takes one."""

    def __init__(
        self, policy: str, rate: float, burst: int, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._policy, self._rate, self._burst, self._clock = policy, rate, burst, clock
        self._levels: OrderedDict[str, tuple[float, float]] = OrderedDict()

    def take(self, client: str) -> Allowance:
        """Takes a token, if there is one."""
        now = self._clock()
        level, at = self._levels.get(client, (float(self._burst), now))
        level = min(float(self._burst), level + (now - at) * self._rate)
        passes = level >= 1
        level -= passes
        self._levels[client] = (level, now)
        self._levels.move_to_end(client)
        if len(self._levels) > CLIENTS_MAX:
            self._levels.popitem(last=False)
        return Allowance(
            policy=self._policy,
            limit=self._burst,
            remaining=int(level),
            full_in_s=math.ceil((self._burst - level) / self._rate),
            wait_s=0 if passes else math.ceil((1 - level) / self._rate),
        )
