"""How many requests a client may send in a time: a bucket of tokens for each, kept by each web process alone.

With several replicas behind a proxy a client may have as many times the rate; what must hold exactly (jobs,
bytes) is counted in the database.
"""

from __future__ import annotations

import math
import time
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass

# Beyond so many clients those that were silent longest are forgotten, and begin with a full bucket again.
CLIENTS_MAX = 10_000


@dataclass(frozen=True)
class Allowance:
    """What a client has left. ``wait_s`` is 0 where the request may pass, else when one may again."""

    policy: str
    limit: int
    remaining: int
    full_in_s: int
    wait_s: int

    def headers(self) -> dict[str, str]:
        """As draft-ietf-httpapi-ratelimit-headers has them."""
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
        """Takes a token where there is one."""
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
