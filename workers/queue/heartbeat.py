"""The worker's heartbeat: a thread with its own connection."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import threading

import psycopg

from workers.database.database import CONNECT, first_line
from workers.database.job_queue import HEARTBEAT

log = logging.getLogger(__name__)


class Heartbeat(threading.Thread):
    """Tells the queue every ``period_s`` that the worker is alive, until `end`.

    A separate thread, because deleting a large folder can block the event loop for longer than the stall time. Drops a
    connection that does not answer within ``answer_s``.
    """

    def __init__(self, url: str, period_s: float, worker_id: int, *, answer_s: float) -> None:
        super().__init__(daemon=True, name="heartbeat")
        self._url, self._period_s, self._worker_id, self._answer_s = url, period_s, worker_id, answer_s
        self._loop = asyncio.new_event_loop()
        self._end = asyncio.Event()

    def run(self) -> None:
        """Send heartbeats until `end`."""
        self._loop.run_until_complete(self._beat())
        self._loop.close()

    def end(self) -> None:
        """Stop; the last heartbeat stays recorded."""
        with contextlib.suppress(RuntimeError):  # it has ended already
            self._loop.call_soon_threadsafe(self._end.set)

    async def _beat(self) -> None:
        connection: psycopg.AsyncConnection | None = None
        while not await self._ended():
            try:
                if connection is None or connection.closed:
                    connection = await psycopg.AsyncConnection.connect(self._url, autocommit=True, **CONNECT)
                await self._send(connection)
            except (psycopg.Error, TimeoutError) as error:
                log.warning("no heartbeat: %s", first_line(error))
                if connection is not None:
                    await connection.close()
                connection = None
        if connection is not None:
            await connection.close()

    async def _send(self, connection: psycopg.AsyncConnection) -> None:
        """Send one; on a timeout raises `TimeoutError` at once: cancelling a query would wait five more seconds."""
        sending = asyncio.ensure_future(connection.execute(HEARTBEAT, (self._worker_id,)))
        await asyncio.wait({sending}, timeout=self._answer_s)
        if not sending.done():
            connection.pgconn.finish()
            sending.cancel()
            await asyncio.gather(sending, return_exceptions=True)
            raise TimeoutError(f"no answer within {self._answer_s:g} s")
        sending.result()

    async def _ended(self) -> bool:
        with contextlib.suppress(TimeoutError):
            await asyncio.wait_for(self._end.wait(), self._period_s)
        return self._end.is_set()
