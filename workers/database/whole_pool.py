"""A pool that loses no connection when a task is cancelled while it takes or returns one."""

from __future__ import annotations

import asyncio
from collections.abc import Coroutine
from typing import Any, TypeVar

import psycopg
from psycopg_pool import AsyncConnectionPool

ACT = TypeVar("ACT", bound=psycopg.AsyncConnection[Any])
T = TypeVar("T")


class WholePool(AsyncConnectionPool[ACT]):
    """The base class leaks a connection if a cancellation interrupts its return.

    Here taking, returning and draining are separate tasks, which are never cancelled halfway. Connections are tested
    when they are taken, so those that the server killed are replaced transparently.
    """

    def __init__(self, conninfo: str, **named: Any) -> None:
        super().__init__(conninfo, check=self._test, **named)
        self._lent = self._tested = 0
        self._own: set[asyncio.Task[Any]] = set()

    def lost(self) -> int:
        """How many of the pool's counted connections nobody holds.

        Includes those that are being opened, so only a number that stays above 0 is a fault.
        """
        held = self.get_stats()
        return int(held["pool_size"]) - int(held["pool_available"]) - self._lent - self._tested

    async def getconn(self, timeout: float | None = None) -> ACT:
        """As the base class's."""
        taking = self._start(self._take(timeout))
        try:
            return await asyncio.shield(taking)
        except asyncio.CancelledError:
            taking.cancel()  # `_take` returns the connection that it is testing
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
