"""Following jobs: one LISTEN connection per process wakes local followers, who then read the tables.

A notification only says "look"; what happened is in the tables. A lost one costs a poll interval, no event.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import time
from collections import defaultdict
from collections.abc import AsyncGenerator, Awaitable, Callable, Iterator

import psycopg

from workers.database import AWAY, CONNECT, LISTEN_CHANNEL, QUIET_S, Database, first_line
from workers.errors import Unavailable
from workers.records import JobUpdate

log = logging.getLogger(__name__)


class Listener:
    """Wakes who waits for a job. ``poll_s`` is how long a lost notification can go unnoticed."""

    def __init__(self, database: Database, poll_s: float) -> None:
        self.poll_s = poll_s
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
                    await connection.execute(f"LISTEN {LISTEN_CHANNEL}".encode())
                    for job_id in list(self._waiting):
                        self._wake(job_id)
                    async for notification in connection.notifies():
                        self._wake(notification.payload)
            except AWAY as error:
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


async def follow(
    read: Callable[[str, int], Awaitable[JobUpdate]],
    listener: Listener,
    job_id: str,
    after: int,
    heartbeat_s: float,
) -> AsyncGenerator[JobUpdate | None]:
    """See `JobStore.subscribe`."""
    revision, said = -1, time.monotonic()
    with listener.waiting(job_id) as changed:
        while True:
            changed.clear()  # before reading: a change during the read is not missed
            try:
                update = await read(job_id, after)
            except Unavailable:
                if revision < 0:
                    raise
                update = None
            if update is not None and update.job.revision != revision:
                revision, said = update.job.revision, time.monotonic()
                after = update.events[-1].seq if update.events else after
                yield update
                if update.job.final:
                    return
            elif time.monotonic() - said >= heartbeat_s:
                said = time.monotonic()
                yield None
            left = heartbeat_s - (time.monotonic() - said)
            with contextlib.suppress(TimeoutError):
                await asyncio.wait_for(changed.wait(), max(0.01, min(listener.poll_s, left)))
