"""Following jobs: one LISTEN connection per process wakes local followers, who then read the tables.

A notification only says "look"; what happened is in the tables. A lost one costs a poll interval, no event.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import time
from collections import defaultdict
from collections.abc import Iterator
from typing import LiteralString

import psycopg

from workers.database.database import AWAY, CONNECT, LISTEN_CHANNEL, QUIET_S, Database, first_line
from workers.settings.errors import Unavailable

log = logging.getLogger(__name__)

ANSWER_S = 10.0


class Listener:
    """Wakes who waits for a job. ``poll_s`` is how long a lost notification can go unnoticed."""

    def __init__(self, database: Database, poll_s: float, channel: LiteralString = LISTEN_CHANNEL) -> None:
        self.poll_s, self._channel = poll_s, channel
        self._database = database
        self._waiting: dict[str, set[asyncio.Event]] = defaultdict(set)

    @contextlib.contextmanager
    def waiting(self, job_id: str) -> Iterator[asyncio.Event]:
        """An event that is set at each change of the job."""
        event = asyncio.Event()
        self._waiting[job_id].add(event)
        try:
            yield event
        finally:
            self._waiting[job_id].discard(event)
            if not self._waiting[job_id]:
                del self._waiting[job_id]

    async def run(self) -> None:
        """Listen until cancelled; reconnects for ever, and wakes everybody after a gap."""
        said_at = 0.0
        while True:
            try:
                async with await psycopg.AsyncConnection.connect(
                    self._database.url, autocommit=True, **CONNECT
                ) as connection:
                    await connection.execute(f"LISTEN {self._channel}".encode())
                    for job_id in list(self._waiting):
                        self._wake(job_id)
                    while True:
                        async for notification in connection.notifies(timeout=QUIET_S):
                            self._wake(notification.payload)
                        async with asyncio.timeout(ANSWER_S):
                            await connection.execute("SELECT 1")  # a line can be dead without an end
            except (*AWAY, TimeoutError) as error:
                if time.monotonic() - said_at > QUIET_S:
                    said_at = time.monotonic()
                    log.warning("event listener lost the database (%s)", first_line(error))
            await asyncio.sleep(0.5)

    def _wake(self, job_id: str) -> None:
        for event in self._waiting.get(job_id, ()):
            event.set()

    async def database_answers(self, timeout_s: float) -> bool:
        """Whether a query comes back in time."""
        try:
            await asyncio.wait_for(self._database.fetch("SELECT 1"), timeout_s)
        except (Unavailable, TimeoutError):
            return False
        return True
