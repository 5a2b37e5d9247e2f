"""A pool that loses no connection when whoever takes or returns one is cancelled."""

from __future__ import annotations

import asyncio
from collections.abc import Coroutine
from typing import Any, TypeVar

import psycopg
from psycopg_pool import AsyncConnectionPool

ACT = TypeVar("ACT", bound=psycopg.AsyncConnection[Any])
T = TypeVar("T")


class WholePool(AsyncConnectionPool[ACT]):
    """The base class forgets a connection, but counts it for ever, where a cancellation meets its return.

    Here taking, returning and draining are tasks of their own, which nobody cancels halfway. Connections are tested
    when they are taken, so that those killed with the server are replaced unseen.
    """

    def __init__(self, conninfo: str, **named: Any) -> None:
        super().__init__(conninfo, check=self._test, **named)
        self._lent = self._tested = 0
        self._own: set[asyncio.Task[Any]] = set()

    def lost(self) -> int:
        """How many connections the pool counts that neither it nor anybody else has.

        Those that are being made count too, so that only a number above 0 for long is a fault.
        """
        held = self.get_stats()
        return int(held["pool_size"]) - int(held["pool_available"]) - self._lent - self._tested

    async def getconn(self, timeout: float | None = None) -> ACT:
        """As the base class's."""
        taking = self._start(self._take(timeout))
        try:
            return await asyncio.shield(taking)
        except asyncio.CancelledError:
            taking.cancel()  # it gives back what it is about to test
            taking.add_done_callback(self._return_unused)
            raise

    async def putconn(self, conn: ACT) -> None:
        """As the base class's."""
        await asyncio.shield(self._start(self._put(conn)))

    async def drain(self) -> None:
        """As the base class's."""
        await asyncio.shield(self._start(super().drain()))

    async def _take(self, timeout: float | None) -> ACT:
        conn = await super().getconn(timeout)
        self._lent += 1
        return conn

    async def _put(self, conn: ACT) -> None:
        try:
            await super().putconn(conn)
        finally:
            self._lent -= 1

    def _return_unused(self, taking: asyncio.Task[ACT]) -> None:
        if not taking.cancelled() and taking.exception() is None:
            self._start(self._put(taking.result()))

    async def _test(self, conn: ACT) -> None:
        self._tested += 1
        try:
            await self.check_connection(conn)
        finally:
            self._tested -= 1

    def _start(self, work: Coroutine[Any, Any, T]) -> asyncio.Task[T]:
        task = asyncio.create_task(work)
        self._own.add(task)  # else it could be garbage-collected
        task.add_done_callback(self._own.discard)
        return task
