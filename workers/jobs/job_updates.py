"""Lets all subscribers of jobs share one poll, and all subscribers of the same job one read."""

from __future__ import annotations

import asyncio
import contextlib
import time
from collections.abc import AsyncGenerator, Awaitable, Callable
from functools import partial

from workers.database.database import Database
from workers.database.notifications import Listener
from workers.records import JobUpdate
from workers.settings.errors import Unavailable

CHANNEL = "biresnerf_jobs"


class JobListener(Listener):
    """Wakes subscribers of jobs. ``poll_s`` is how long a lost notification can go unnoticed."""

    def __init__(self, database: Database, poll_s: float) -> None:
        super().__init__(database, poll_s, CHANNEL)
        self._revisions: dict[str, int | None] = {}
        self._change = 0
        self._changes: dict[str, int] = {}
        self._reads: dict[tuple[object, ...], asyncio.Task[JobUpdate]] = {}

    async def run(self) -> None:
        """Listen and poll until cancelled."""
        await asyncio.gather(super().run(), self._look())

    async def read_shared(
        self,
        viewer: str | None,
        job_id: str,
        after: int,
        read: Callable[[str, int], Awaitable[JobUpdate]],
    ) -> JobUpdate:
        """The result of ``read``, shared by equal requests of the same ``viewer`` since the job's last change.

        Call it only while `waiting` for the job: a change during the read then wakes the caller again.
        """
        key = (viewer, job_id, after, self._changes.get(job_id))
        reading = self._reads.get(key)
        if reading is None:
            reading = self._reads[key] = asyncio.ensure_future(read(job_id, after))
            reading.add_done_callback(partial(self._has_read, key))
        return await asyncio.shield(reading)

    def _has_read(self, key: tuple[object, ...], reading: asyncio.Task[JobUpdate]) -> None:
        del self._reads[key]
        if not reading.cancelled():
            reading.exception()  # marks it as retrieved: all callers may have left

    def _wake(self, job_id: str) -> None:
        if job_id in self._waiting:
            self._change += 1
            self._changes[job_id] = self._change
        super()._wake(job_id)

    async def _look(self) -> None:
        while True:
            await asyncio.sleep(self.poll_s)
            followed = list(self._waiting)
            self._changes = {job_id: self._changes[job_id] for job_id in followed if job_id in self._changes}
            if not followed:
                continue
            try:
                rows = await self._database.fetch(
                    "SELECT id, revision FROM jobs WHERE id = ANY(%s)", followed
                )
            except Unavailable:
                continue
            found: dict[str, int | None] = dict.fromkeys(followed)
            found |= {row["id"]: row["revision"] for row in rows}
            for job_id, revision in found.items():
                if job_id not in self._revisions or self._revisions[job_id] != revision:
                    self._wake(job_id)
            self._revisions = found


async def follow(
    read: Callable[[str, int], Awaitable[JobUpdate]],
    listener: JobListener,
    viewer: str | None,
    job_id: str,
    after: int,
    heartbeat_s: float,
) -> AsyncGenerator[JobUpdate | None]:
    """See `JobStore.subscribe`."""
    revision, sent_at = -1, time.monotonic()
    with listener.waiting(job_id) as changed:
        while True:
            changed.clear()  # before reading, so that a change meanwhile is not missed
            try:
                update = await listener.read_shared(viewer, job_id, after, read)
                pause_s = heartbeat_s
            except Unavailable:
                if revision < 0:
                    raise
                update, pause_s = None, listener.poll_s
            if update is not None and update.job.revision != revision:
                revision, sent_at = update.job.revision, time.monotonic()
                after = update.events[-1].seq if update.events else after
                yield update
                if update.job.final:
                    return
            elif time.monotonic() - sent_at >= heartbeat_s:
                sent_at = time.monotonic()
                yield None
            left = heartbeat_s - (time.monotonic() - sent_at)
            with contextlib.suppress(TimeoutError):
                await asyncio.wait_for(changed.wait(), max(0.01, min(pause_s, left)))
