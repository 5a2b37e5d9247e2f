"""Notifications: each process has a LISTEN connection that wakes local waiters, which then read the tables.

A notification only says "look"; the tables hold what happened. If one is lost, its event is seen at the next poll.
"""

from __future__ import annotations

import asyncio
import contextlib
from collections import defaultdict
from collections.abc import Callable, Iterator

import psycopg
from psycopg import sql

from workers.database.database import AWAY, CONNECT, Database, first_line
from workers.process.waiting import retry_while_unavailable
from workers.settings.errors import Unavailable

QUIET_S = 60.0  # without a notification: then check the connection
ANSWER_S = 10.0


class Listener:
    """Wakes those who wait for a subject, usually a job.

    Args:
        poll_s: how long a lost notification can go unnoticed.
        channels: the channels to listen on.
        subject_of: maps a notification to its subject.
    """

    def __init__(
        self,
        database: Database,
        poll_s: float,
        *channels: str,
        subject_of: Callable[[str], str] = str,
    ) -> None:
        self.poll_s, self._channels, self._subject_of = poll_s, channels, subject_of
        self._database = database
        self._waiting: dict[str, set[asyncio.Event]] = defaultdict(set)

    @contextlib.contextmanager
    def waiting(self, subject: str) -> Iterator[asyncio.Event]:
        """An event that is set at each notification about the subject."""
        event = asyncio.Event()
        self._waiting[subject].add(event)
        try:
            yield event
        finally:
            self._waiting[subject].discard(event)
            if not self._waiting[subject]:
                del self._waiting[subject]

    async def run(self) -> None:
        """Listen until cancelled; always reconnects, and wakes everybody after a gap."""
        await retry_while_unavailable(self._listen)

    async def _listen(self) -> None:
        try:
            async with await psycopg.AsyncConnection.connect(
                self._database.url, autocommit=True, **CONNECT
            ) as connection:
                for channel in self._channels:
                    await connection.execute(sql.SQL("LISTEN {}").format(sql.Identifier(channel)))
                for subject in list(self._waiting):
                    self._wake(subject)
                while True:
                    async for notification in connection.notifies(timeout=QUIET_S):
                        self._wake(self._subject_of(notification.payload))
                    async with asyncio.timeout(ANSWER_S):
                        await connection.execute("SELECT 1")  # a dead connection may never say so
        except (*AWAY, TimeoutError) as error:
            raise Unavailable(
                "database_unavailable", f"The listener lost the database: {first_line(error)}"
            ) from error

    def _wake(self, subject: str) -> None:
        for event in self._waiting.get(subject, ()):
            event.set()
