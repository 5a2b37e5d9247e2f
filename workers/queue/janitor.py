"""Puts jobs of dead workers back into the queue, and takes the trash out.

Everything about one job happens in one transaction, job row locked first, so two janitors and a cancelling
client cannot undo each other's work.
"""

from __future__ import annotations

import asyncio
import logging
import time
from collections.abc import Awaitable, Callable, Collection
from functools import partial

from psycopg.types.json import Jsonb

from workers.database.database import QUEUE, Connection, Database
from workers.database.statistics import fold_tallies
from workers.jobs.job_completion import finish_cancelled
from workers.queue.fenced_worker import offer_again
from workers.settings.errors import Unavailable
from workers.settings.settings import Settings
from workers.store.files import FileStore
from workers.store.trash import take_trash_out

log = logging.getLogger(__name__)

JANITOR_LOCK = 7_201_605
ROUNDS_UNTIL_LOST = 3
UPKEEP_S = 3600
KEEP_QUEUE_ROWS_H = 24


class Janitor:
    """Runs in every worker; only one of them works at a time.

    Args:
        worker_id: this worker's id in the queue, once it has one.
        running: queue rows that this worker really works on.
    """

    def __init__(
        self,
        database: Database,
        files: FileStore,
        settings: Settings,
        worker_id: Callable[[], int | None],
        running: Collection[int],
    ) -> None:
        self._database, self._files, self._settings = database, files, settings
        self._worker_id, self._running = worker_id, running
        self._healthy_since: float | None = None
        self._saw_outage = False
        self._round_at: float | None = None
        self._unacknowledged: dict[int, int] = {}
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
            await self._release_unacknowledged(connection)
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
            await self._database.app.job_manager.delete_old_jobs(
                KEEP_QUEUE_ROWS_H, include_failed=True, include_cancelled=True, include_aborted=True
            )

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
        cursor = await connection.execute(
            "SELECT job.id FROM procrastinate_jobs AS job LEFT JOIN procrastinate_workers AS worker"
            " ON worker.id = job.worker_id WHERE job.status = 'doing' AND job.queue_name = %s"
            " AND (worker.id IS NULL OR worker.last_heartbeat < now() - make_interval(secs => %s))"
            " ORDER BY job.id",
            (QUEUE, self._settings.stall_s),
        )
        for row in await cursor.fetchall():
            await release(connection, row["id"], "worker_lost")
        await connection.execute(
            "DELETE FROM procrastinate_workers WHERE last_heartbeat < now() - make_interval(secs => %s)",
            (self._settings.stall_s,),
        )

    async def _release_unacknowledged(self, connection: Connection) -> None:
        """Our own rows that we do not work on: the database went away between the result and the receipt."""
        cursor = await connection.execute(
            "SELECT id FROM procrastinate_jobs WHERE status = 'doing' AND worker_id = %s",
            (self._worker_id(),),
        )
        idle = {row["id"] for row in await cursor.fetchall()} - set(self._running)
        self._unacknowledged = {key: self._unacknowledged.get(key, 0) + 1 for key in idle}
        for queue_id, rounds in self._unacknowledged.items():
            if rounds >= ROUNDS_UNTIL_LOST:
                await release(connection, queue_id, "receipt_lost")

    async def _requeue_lost(self, connection: Connection) -> None:
        """Unfinished jobs that the queue does not know (any more)."""
        cursor = await connection.execute(
            "SELECT jobs.id FROM jobs LEFT JOIN procrastinate_jobs AS queue ON queue.id = jobs.queue_id"
            " WHERE jobs.state IN ('queued', 'running')"
            " AND jobs.updated_at < clock_timestamp() - make_interval(secs => %s)"
            " AND coalesce(queue.status NOT IN ('todo', 'doing'), true) FOR UPDATE OF jobs SKIP LOCKED",
            (self._settings.stall_s,),
        )
        for row in await cursor.fetchall():
            log.warning("job %s was lost by the queue; queueing it again", row["id"])
            queue_id = await self._database.enqueue(connection, row["id"])
            await connection.execute(
                "UPDATE jobs SET state = 'queued', run_token = NULL, queue_id = %s WHERE id = %s",
                (queue_id, row["id"]),
            )
            await connection.execute(
                "SELECT add_job_event(%s, 'requeued', %s)", (row["id"], Jsonb({"why": "lost"}))
            )


async def release(connection: Connection, queue_id: int, why: str) -> None:
    """Take a queue row from a worker that is gone, in the caller's transaction.

    The job goes back to the queue (its attempt stays counted); one that should be cancelled, or is final
    already, leaves the queue. The token is dropped, so a worker that was only asleep is fenced from here on.
    """
    cursor = await connection.execute(
        "SELECT id, cancel_requested FROM jobs"
        " WHERE queue_id = %s AND state IN ('queued', 'running') FOR UPDATE",  # of these there is an index
        (queue_id,),
    )
    job = await cursor.fetchone()
    cursor = await connection.execute(
        "SELECT 1 FROM procrastinate_jobs WHERE id = %s AND status = 'doing' FOR UPDATE", (queue_id,)
    )
    if await cursor.fetchone() is None:
        return  # it came to an end in the meantime
    if job is None:  # or final
        await connection.execute("SELECT procrastinate_finish_job_v1(%s, 'aborted', false)", (queue_id,))
        return
    log.warning("taking job %s back (%s)", job["id"], why)
    if job["cancel_requested"]:
        await connection.execute("UPDATE jobs SET run_token = NULL WHERE id = %s", (job["id"],))
        await finish_cancelled(connection, job["id"])
        await connection.execute("SELECT procrastinate_finish_job_v1(%s, 'aborted', false)", (queue_id,))
        return
    await connection.execute(
        "UPDATE jobs SET state = 'queued', run_token = NULL, eta_s = NULL WHERE id = %s", (job["id"],)
    )
    await connection.execute("SELECT add_job_event(%s, 'requeued', %s)", (job["id"], Jsonb({"why": why})))
    await offer_again(connection, queue_id)


async def release_worker(database: Database, worker_id: int | None) -> None:
    """Release all of a worker known to be dead, at once; none means every worker of this database."""
    async with database.transaction() as connection:
        cursor = await connection.execute(
            "SELECT id FROM procrastinate_jobs WHERE status = 'doing' AND queue_name = %s"
            " AND (%s::bigint IS NULL OR worker_id = %s) ORDER BY id",  # two of us lock in the same order
            (QUEUE, worker_id, worker_id),
        )
        for row in await cursor.fetchall():
            await release(connection, row["id"], "worker_lost")
        await connection.execute(
            "DELETE FROM procrastinate_workers WHERE %s::bigint IS NULL OR id = %s", (worker_id, worker_id)
        )
