"""Requeues jobs of dead workers, ends overdue ones, and empties the trash.

All changes of one job happen in one transaction that locks its row first, so two janitors and a cancelling client
cannot undo each other's work.
"""

from __future__ import annotations

import asyncio
import logging
import time
from collections.abc import Awaitable, Callable
from functools import partial

from workers.database import job_queue
from workers.database.database import Connection, Database
from workers.database.statistics import fold_tallies, fold_use
from workers.jobs.deadlines import end_overdue_jobs
from workers.jobs.job_expiry import drop_left_checkpoints
from workers.jobs.job_states import cancel_part_of_ended, offer_held_jobs, requeue_lost, take_back
from workers.settings.errors import Unavailable
from workers.settings.settings import Settings
from workers.store.files import FileStore
from workers.store.trash import empty_trash
from workers.tenants.token_buckets import forget_full_buckets

log = logging.getLogger(__name__)

JANITOR_LOCK = 7_201_605
UPKEEP_S = 3600


class Janitor:
    """Runs in every worker; only one of them works at a time."""

    def __init__(self, database: Database, files: FileStore, settings: Settings) -> None:
        self._database, self._files, self._settings = database, files, settings
        self._healthy_since: float | None = None
        self._saw_outage = False
        self._round_at: float | None = None
        self._upkeep_at = time.monotonic()

    async def run(self) -> None:
        """Repeat rounds until cancelled."""
        # The trash is separate: it can take long, and a pause between rounds means that the machine slept.
        trash = partial(empty_trash, self._database, self._files)
        await asyncio.gather(self._repeat(self._round), self._repeat(trash))

    async def _repeat(self, duty: Callable[[], Awaitable[None]]) -> None:
        while True:
            await asyncio.sleep(self._settings.janitor_s)
            try:
                await duty()
            except Unavailable as error:
                log.warning("janitor: %s", error)
                if error.code == "database_unavailable":
                    self._healthy_since, self._saw_outage = None, True
            except Exception:  # it must go on: nothing would restart it
                log.exception("janitor: this round failed")

    async def _round(self) -> None:
        async with self._database.transaction() as connection:
            row = await connection.only_row(
                "SELECT pg_try_advisory_xact_lock(%s) AS mine,"
                " extract(epoch FROM now() - pg_postmaster_start_time())::float8 AS database_age_s,"
                " extract(epoch FROM clock_timestamp())::float8 AS now_s",
                JANITOR_LOCK,
            )
            self._note_pause(row["now_s"])
            if self._healthy_since is None:
                self._healthy_since = time.monotonic()
            if row["mine"]:
                if self._silent_workers_are_dead(row["database_age_s"]):
                    await self._release_stalled(connection)
                await requeue_lost(connection, self._settings.stall_s)
                await end_overdue_jobs(connection, self._settings.stall_s)
                await offer_held_jobs(connection)
                while await cancel_part_of_ended(connection, self._settings.stall_s):
                    pass
                await fold_tallies(connection)
                await forget_full_buckets(connection)
        if time.monotonic() >= self._upkeep_at:
            self._upkeep_at = time.monotonic() + UPKEEP_S
            await self._database.run(job_queue.delete_old_entries)
            await self._database.run(fold_use)
            await self._database.run(partial(drop_left_checkpoints, stall_s=self._settings.stall_s))

    def _note_pause(self, now_s: float) -> None:
        """Note when the machine slept or the database froze: then all workers were silent though alive.

        Measured by the database's clock: our monotonic clock stands still while a machine sleeps.
        """
        paused_s = now_s - self._round_at if self._round_at is not None else 0.0
        self._round_at = now_s
        if paused_s > self._settings.janitor_s + self._settings.stall_s / 2:
            log.warning("janitor: paused for %.0f s; workers get time for a heartbeat", paused_s)
            self._healthy_since, self._saw_outage = None, True

    def _silent_workers_are_dead(self, database_age_s: float) -> bool:
        """Whether silence means death: after a database outage, living workers first need time for a heartbeat."""
        patience_s = 1.5 * self._settings.stall_s
        seen_s = time.monotonic() - (self._healthy_since or time.monotonic())
        return seen_s >= patience_s or (not self._saw_outage and database_age_s >= patience_s)

    async def _release_stalled(self, connection: Connection) -> None:
        for entry_id in await job_queue.entries_of_silent_workers(connection, self._settings.stall_s):
            await take_back(connection, entry_id, self._settings.stall_s)
        await job_queue.unregister_silent_workers(connection, self._settings.stall_s)


async def release_worker(database: Database, worker_id: int | None, stall_s: float) -> None:
    """Release everything of a worker known to be dead, at once; None means all workers of this database."""
    async with database.transaction() as connection:
        for entry_id in await job_queue.entries_of_worker(connection, worker_id):
            await take_back(connection, entry_id, stall_s)
        await job_queue.unregister_worker(connection, worker_id)
