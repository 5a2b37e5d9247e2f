"""Rate limits: what a client may still send, as the headers of a response tell it."""

from __future__ import annotations

import math
from dataclasses import dataclass

from workers.tenants.token_buckets import TokenBuckets


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


@dataclass(frozen=True)
class RateLimit:
    """At most ``burst`` requests of one client at once, and ``rate`` a second on average, in all web processes."""

    policy: str
    rate: float
    burst: int

    async def take(self, buckets: TokenBuckets, client: str) -> Allowance:
        """Counts a request, if it is allowed; raises `Unavailable`."""
        level = await buckets.take(self.policy, client, self.rate, self.burst)
        return Allowance(
            policy=self.policy,
            limit=self.burst,
            remaining=int(level.tokens),
            full_in_s=math.ceil(level.full_in_s),
            wait_s=math.ceil(level.wait_s),
        )
