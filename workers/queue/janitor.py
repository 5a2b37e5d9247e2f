"""Puts jobs of dead workers back into the queue, and takes the trash out.

Everything about one job happens in one transaction, job row locked first, so two janitors and a cancelling
client cannot undo each other's work.
"""

from __future__ import annotations

import asyncio
import logging
import time
from collections.abc import Awaitable, Callable
from functools import partial

from psycopg.types.json import Jsonb

from workers.database import job_queue
from workers.database.database import Connection, Database
from workers.database.statistics import fold_tallies
from workers.jobs.job_completion import finish_cancelled
from workers.jobs.job_rows import queue_job
from workers.settings.errors import Unavailable
from workers.settings.settings import Settings
from workers.store.files import FileStore
from workers.store.trash import take_trash_out

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
        """Rounds until cancelled."""
        # Apart, for it can take long, and the pauses between two rounds tell something.
        trash = partial(take_trash_out, self._database, self._files)
        await asyncio.gather(self._again_and_again(self._round), self._again_and_again(trash))

    async def _again_and_again(self, duty: Callable[[], Awaitable[None]]) -> None:
        while True:
            await asyncio.sleep(self._settings.janitor_s)
            try:
                await duty()
            except Unavailable as error:
                log.warning("janitor: %s", error)
                if error.code == "database_unavailable":
                    self._healthy_since, self._saw_outage = None, True
            except Exception:  # it must not end: nobody would take its place here
                log.exception("janitor: this round failed")

    async def _round(self) -> None:
        async with self._database.transaction() as connection:
            cursor = await connection.execute(
                "SELECT pg_try_advisory_xact_lock(%s) AS mine,"
                " extract(epoch FROM now() - pg_postmaster_start_time())::float8 AS database_age_s,"
                " extract(epoch FROM clock_timestamp())::float8 AS now_s",
                (JANITOR_LOCK,),
            )
            row = await cursor.fetchone()
            assert row is not None, "a SELECT without FROM gives a row"
            self._distrust_after_a_pause(row["now_s"])
            if self._healthy_since is None:
                self._healthy_since = time.monotonic()
            if row["mine"]:
                if self._silence_means_death(row["database_age_s"]):
                    await self._release_stalled(connection)
                await self._requeue_lost(connection)
                # Ends make room by themselves; this is for limits that were changed, and jobs passed over.
                await connection.execute(
                    "SELECT offer_held(tenant)"
                    " FROM (SELECT DISTINCT tenant FROM jobs WHERE held AND state = 'queued') AS waiting"
                )
                await fold_tallies(connection)
        if time.monotonic() >= self._upkeep_at:
            self._upkeep_at = time.monotonic() + UPKEEP_S
            async with self._database.transaction() as connection:
                await job_queue.delete_old_entries(connection)

    def _distrust_after_a_pause(self, now_s: float) -> None:
        """A machine that slept, or a database that froze: everybody was silent, and everybody lives.

        Told by the database's clock, for the one we measure pauses with stands still while a machine sleeps.
        """
        paused_s = now_s - self._round_at if self._round_at is not None else 0.0
        self._round_at = now_s
        if paused_s > self._settings.janitor_s + self._settings.stall_s / 2:
            log.warning("janitor: nothing went on for %.0f s; workers get time to give a sign", paused_s)
            self._healthy_since, self._saw_outage = None, True

    def _silence_means_death(self, database_age_s: float) -> bool:
        """After an outage of the database living workers first need time to give a sign."""
        patience_s = 1.5 * self._settings.stall_s
        seen_s = time.monotonic() - (self._healthy_since or time.monotonic())
        return seen_s >= patience_s or (not self._saw_outage and database_age_s >= patience_s)

    async def _release_stalled(self, connection: Connection) -> None:
        for entry_id in await job_queue.entries_of_silent_workers(connection, self._settings.stall_s):
            await release(connection, entry_id)
        await job_queue.unregister_silent_workers(connection, self._settings.stall_s)

    async def _requeue_lost(self, connection: Connection) -> None:
        """Unfinished jobs that the queue does not know (any more)."""
        cursor = await connection.execute(
            "SELECT jobs.id FROM jobs LEFT JOIN queue_entries AS entry ON entry.id = jobs.queue_id"
            " WHERE jobs.state IN ('queued', 'running')"
            " AND jobs.updated_at < clock_timestamp() - make_interval(secs => %s)"
            " AND coalesce(entry.state NOT IN ('todo', 'doing'), true) FOR UPDATE OF jobs SKIP LOCKED",
            (self._settings.stall_s,),
        )
        for row in await cursor.fetchall():
            log.warning("job %s was lost by the queue; queueing it again", row["id"])
            await connection.execute(
                "UPDATE jobs SET state = 'queued', run_token = NULL WHERE id = %s", (row["id"],)
            )
            await queue_job(connection, row["id"])
            await connection.execute(
                "SELECT add_job_event(%s, 'requeued', %s)", (row["id"], Jsonb({"why": "lost"}))
            )


async def release(connection: Connection, entry_id: int) -> None:
    """Take a queue entry from a worker that is gone, in the caller's transaction.

    The job goes back to the queue (its attempt stays counted); one that should be cancelled, or is final
    already, leaves the queue. The token is dropped, so a worker that was only asleep is fenced from here on.
    """
    cursor = await connection.execute(
        "SELECT id, cancel_requested FROM jobs"
        " WHERE queue_id = %s AND state IN ('queued', 'running') FOR UPDATE",  # of these there is an index
        (entry_id,),
    )
    job = await cursor.fetchone()
    if not await job_queue.lock_taken(connection, entry_id):
        return  # it came to an end in the meantime
    if job is None:  # or final
        await job_queue.abort(connection, entry_id)
        return
    log.warning("taking job %s back: its worker is gone", job["id"])
    if job["cancel_requested"]:
        await connection.execute("UPDATE jobs SET run_token = NULL WHERE id = %s", (job["id"],))
        await finish_cancelled(connection, job["id"])
        await job_queue.abort(connection, entry_id)
        return
    await connection.execute(
        "UPDATE jobs SET state = 'queued', run_token = NULL, eta_s = NULL WHERE id = %s", (job["id"],)
    )
    await connection.execute(
        "SELECT add_job_event(%s, 'requeued', %s)", (job["id"], Jsonb({"why": "worker_lost"}))
    )
    await job_queue.put_back(connection, entry_id)


async def release_worker(database: Database, worker_id: int | None) -> None:
    """Release all of a worker known to be dead, at once; none means every worker of this database."""
    async with database.transaction() as connection:
        for entry_id in await job_queue.entries_of_worker(connection, worker_id):
            await release(connection, entry_id)
        await job_queue.unregister_worker(connection, worker_id)
