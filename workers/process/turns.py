"""Limits heavy work to a few items at a time per process, shared fairly between tenants."""

from __future__ import annotations

import asyncio
from collections import OrderedDict, deque
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager


class Turns:
    """At most ``at_once`` turns at a time. Waiting tenants get them in rotation.

    A tenant with a hundred requests delays each other tenant by one, not by a hundred.
    """

    def __init__(self, at_once: int) -> None:
        self._free = at_once
        # In order: whose turn is next comes first.
        self._waiting: OrderedDict[str, deque[asyncio.Future[None]]] = OrderedDict()

    @asynccontextmanager
    async def turn(self, tenant: str) -> AsyncIterator[None]:
        """Waits for a turn, which lasts as long as the context."""
        await self._take(tenant)
        try:
            yield
        finally:
            self._pass_on()

    async def _take(self, tenant: str) -> None:
        if self._free:
            self._free -= 1
            return
        mine = asyncio.get_running_loop().create_future()
        self._waiting.setdefault(tenant, deque()).append(mine)
        try:
            await mine
        except asyncio.CancelledError:
            if mine.done() and not mine.cancelled():
                self._pass_on()  # granted just now, and no longer needed
            raise

    def _pass_on(self) -> None:
        while self._waiting:
            tenant, waiting = next(iter(self._waiting.items()))
            heir = waiting.popleft()
            self._waiting.move_to_end(tenant)
            if not waiting:
                del self._waiting[tenant]
            if not heir.done():
                heir.set_result(None)
                return
        self._free += 1
