"""Connections that the server ends at a chosen statement, and statements that wait for something else to happen."""

from __future__ import annotations

import asyncio
import contextlib
import time
from collections.abc import AsyncIterator, Iterator
from contextvars import ContextVar
from dataclasses import dataclass, field
from typing import Any

import psycopg
from psycopg.rows import dict_row
from psycopg_pool import AsyncConnectionPool

from workers.database.database import Connection, Database

AFTER_COMMIT = -1  # the place between the first commit and its answer


class ProcessDied(BaseException):
    """The process that made the call is gone: it tries nothing again, and tells nobody."""


@dataclass
class Faults:
    """What goes wrong in one call. Places count its statements; each commit is two: before it, and after it.

    Attributes:
        cuts: places at which the server ends the connection.
        dies: the process is gone after the first cut.
        pauses: the place at which the call waits for `go_on`.
    """

    cuts: tuple[int, ...] = ()
    dies: bool = False
    pauses: int | None = None
    place: int = 0
    committed: bool = False
    reached: asyncio.Event = field(default_factory=asyncio.Event)
    go_on: asyncio.Event = field(default_factory=asyncio.Event)


_faults: ContextVar[Faults | None] = ContextVar("faults", default=None)


@contextlib.contextmanager
def faults_in(faults: Faults) -> Iterator[None]:
    """Every statement of this task from here on meets the faults."""
    before = _faults.set(faults)
    try:
        yield
    finally:
        _faults.reset(before)


class FaultyConnection(Connection):
    """A connection to a real server, which ends it where the faults of the running call say so."""

    ender: psycopg.Connection  # ends others

    async def execute(self, query: Any, *arguments: Any, **named: Any) -> Any:
        await self._meet_faults()
        return await super().execute(query, *arguments, **named)

    async def commit(self) -> None:
        await self._meet_faults()
        await super().commit()
        faults = _faults.get()
        answered = faults is None or faults.committed
        if faults is not None:
            faults.committed = True
        if await self._meet_faults() or (not answered and await self._meet_faults(AFTER_COMMIT)):
            self.pgconn.finish()  # or the pool would not know
            raise psycopg.OperationalError("the answer to the commit was lost")

    async def _meet_faults(self, here: int | None = None) -> bool:
        """Whether the connection was cut."""
        faults = _faults.get()
        if faults is None:
            return False
        if here is None:
            here, faults.place = faults.place, faults.place + 1
        if here == faults.pauses:
            faults.reached.set()
            await faults.go_on.wait()
        if here not in faults.cuts:
            return False
        self._end()
        if faults.dies:
            self.pgconn.finish()
            raise ProcessDied
        return True

    def _end(self) -> None:
        """Have the server end this connection, and wait until it has (its own waiting is in tenths of a second)."""
        pid = (self.info.backend_pid,)
        self.ender.execute("SELECT pg_terminate_backend(%s)", pid)
        while self.ender.execute("SELECT 1 FROM pg_stat_activity WHERE pid = %s", pid).fetchone():
            time.sleep(0.0005)


@contextlib.asynccontextmanager
async def open_faulty_database(url: str) -> AsyncIterator[Database]:
    """A database as `open_database` gives it, on connections that can be cut."""
    pool: AsyncConnectionPool[FaultyConnection] = AsyncConnectionPool(
        url,
        min_size=3,
        max_size=4,
        kwargs={"row_factory": dict_row},
        connection_class=FaultyConnection,
        open=False,
    )
    with psycopg.connect(url, autocommit=True) as ender:
        FaultyConnection.ender = ender
        async with pool:
            yield Database(url, pool, answer_s=20.0)  # type: ignore[arg-type]


def waits_for_a_lock() -> bool:
    """Whether some transaction waits for another one."""
    return FaultyConnection.ender.execute("SELECT 1 FROM pg_locks WHERE NOT granted").fetchone() is not None
