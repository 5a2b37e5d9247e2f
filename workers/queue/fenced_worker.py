"""What a worker tells the queue at the end of a job, and only of rows that are still its own."""

from __future__ import annotations

import json
import logging
from datetime import datetime

from procrastinate import JobContext
from procrastinate.job_context import JobResult
from procrastinate.jobs import Job, Status
from procrastinate.retry import RetryDecision
from procrastinate.worker import Worker

from workers.database.database import QUEUE, Connection, Database
from workers.run.claim import insist

log = logging.getLogger(__name__)


class FencedWorker(Worker):
    """The queue's worker, except that its receipts are fenced, and wait for a database that is away.

    The engine's own would put a row back into the queue, or end it, whoever works on it by now: the receipt of
    a worker that was frozen between its last write and this one.
    """

    def __init__(self, database: Database, **options: object) -> None:
        super().__init__(database.app, **options)  # type: ignore[arg-type]
        self._database = database

    async def _persist_job_status(
        self,
        job: Job,
        status: Status,
        retry_decision: RetryDecision | None,
        context: JobContext,
        job_result: JobResult | None,
    ) -> None:
        assert job.id is not None, "fetched from the database"
        queue_id = job.id

        async def once() -> None:
            async with self._database.transaction() as connection:
                cursor = await connection.execute(
                    "SELECT 1 FROM procrastinate_jobs WHERE id = %s AND worker_id = %s AND status = 'doing'"
                    " FOR UPDATE",
                    (queue_id, self.worker_id),
                )
                if await cursor.fetchone() is None:
                    log.warning("queue row %d is not ours any more", queue_id)
                elif retry_decision is not None:
                    await offer_again(connection, queue_id, retry_decision.retry_at)
                else:
                    await connection.execute(
                        "SELECT procrastinate_finish_job_v1(%s, %s, false)", (queue_id, status.value)
                    )

        await insist(once)
        self._job_ids_to_abort.pop(queue_id, None)


async def offer_again(connection: Connection, queue_id: int, not_before: datetime | None = None) -> None:
    """Put a row that is worked on back into the queue, in the caller's transaction, and wake idle workers."""
    await connection.execute(
        "SELECT procrastinate_retry_job_v2(%s,"
        " CASE WHEN %s::timestamptz > clock_timestamp() THEN %s::timestamptz END, NULL, NULL, NULL)",
        (queue_id, not_before, not_before),
    )
    # The engine notifies of new rows only; without this an idle worker finds it at its next look.
    await connection.execute(
        "SELECT pg_notify(%s, %s)",
        (f"procrastinate_queue_v1#{QUEUE}", json.dumps({"type": "job_inserted", "job_id": queue_id})),
    )
