"""The worker's sign of life: a thread with a connection of its own."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import threading
from collections.abc import Callable

import psycopg

from workers.database.database import CONNECT, first_line

log = logging.getLogger(__name__)

# Puts the worker on the list again where a janitor struck it off: it was frozen and has woken up. A job that it
# had then has a new owner; it can take the next one.
ALIVE = (
    "INSERT INTO procrastinate_workers (id) OVERRIDING SYSTEM VALUE VALUES (%s)"
    " ON CONFLICT (id) DO UPDATE SET last_heartbeat = now()"
)


class Beat(threading.Thread):
    """Tells the queue every ``period_s`` that worker ``worker_id()`` lives; tries again for ever.

    A thread, because the queue's own beat lives in the event loop, ends when the worker begins to drain, and
    stops the worker when the database is away for half a minute. A connection on which no answer comes for
    ``answer_s`` is given up.
    """

    def __init__(
        self, url: str, period_s: float, worker_id: Callable[[], int | None], *, answer_s: float
    ) -> None:
        super().__init__(daemon=True, name="beat")
        self._url, self._period_s, self._worker_id, self._answer_s = url, period_s, worker_id, answer_s
        self._loop = asyncio.new_event_loop()
        self._end = asyncio.Event()

    def run(self) -> None:
        """Beat until `end`."""
        self._loop.run_until_complete(self._beat())
        self._loop.close()

    def end(self) -> None:
        """Stop; the last sign of life stays."""
        with contextlib.suppress(RuntimeError):  # it has ended already
            self._loop.call_soon_threadsafe(self._end.set)

    async def _beat(self) -> None:
        connection: psycopg.AsyncConnection | None = None
        while not await self._told_to_end():
            worker_id = self._worker_id()
            if worker_id is None:
                continue
            try:
                if connection is None or connection.closed:
                    connection = await psycopg.AsyncConnection.connect(self._url, autocommit=True, **CONNECT)
                await self._say(connection, worker_id)
            except (psycopg.Error, TimeoutError) as error:
                log.warning("no sign of life: %s", first_line(error))
                if connection is not None:
                    await connection.close()
                connection = None
        if connection is not None:
            await connection.close()

    async def _say(self, connection: psycopg.AsyncConnection, worker_id: int) -> None:
        """Raises `TimeoutError`, and at once: a query that is cancelled waits five more seconds for its server."""
        saying = asyncio.ensure_future(connection.execute(ALIVE, (worker_id,)))
        await asyncio.wait({saying}, timeout=self._answer_s)
        if not saying.done():
            connection.pgconn.finish()
            saying.cancel()
            await asyncio.gather(saying, return_exceptions=True)
            raise TimeoutError(f"no answer within {self._answer_s:g} s")
        saying.result()

    async def _told_to_end(self) -> bool:
        with contextlib.suppress(TimeoutError):
            await asyncio.wait_for(self._end.wait(), self._period_s)
        return self._end.is_set()
