"""What the operator of an installation looks at: queue, slots, sizes and failures, read in one snapshot."""

from __future__ import annotations

from biresnerf.wire.operator import FailedJob, OperatorView, PriorityCount, RunningJob, SlotView
from workers.database.database import Database
from workers.records import PRIORITIES, record_from_row

FAILURES_SHOWN = 20
_SLOTS = """
    SELECT slots.host, slots.name, slots.kind, worker.last_heartbeat AS beat_at,
        worker.last_heartbeat > now() - make_interval(secs => %s) AS alive,
        coalesce(jsonb_agg(to_jsonb(job) ORDER BY job.since) FILTER (WHERE job.id IS NOT NULL), '[]') AS jobs
    FROM slots JOIN queue_workers AS worker ON worker.id = slots.worker_id
    LEFT JOIN queue_entries AS entry ON entry.worker_id = worker.id AND entry.state = 'doing'
    LEFT JOIN running_jobs AS job ON job.queue_id = entry.id
    GROUP BY 1, 2, 3, 4 ORDER BY 1, 2"""
_SIZES = """
    SELECT clock_timestamp() AS at, (SELECT sum(stored_bytes_of(id)) FROM tenants)::bigint AS stored_bytes,
        pg_database_size(current_database()) AS database_bytes, (SELECT count(*) FROM trash) AS trash,
        (SELECT count(*) FROM webhook_deliveries WHERE state = 'pending') AS webhooks_pending"""
_FAILURES = "SELECT * FROM failed_jobs ORDER BY finished_at DESC LIMIT %s"


async def read_overview(database: Database, stall_s: float) -> OperatorView:
    """The installation now; a slot is alive if it sent a heartbeat within ``stall_s``. Raises `Unavailable`."""
    async with database.transaction() as connection:
        await connection.execute("SET TRANSACTION ISOLATION LEVEL REPEATABLE READ READ ONLY")
        counts = {row["priority"]: row for row in await connection.rows("SELECT * FROM unfinished_jobs")}
        slots = await connection.rows(_SLOTS, stall_s)
        failures = await connection.rows(_FAILURES, FAILURES_SHOWN)
        sizes = await connection.only_row(_SIZES)
    return OperatorView(
        queue=tuple(
            record_from_row(PriorityCount, counts.get(PRIORITIES[name], {}), priority=name)
            for name in ("high", "normal", "low")
        ),
        slots=tuple(
            record_from_row(SlotView, row, jobs=[record_from_row(RunningJob, job) for job in row["jobs"]])
            for row in slots
        ),
        failures=tuple(FailedJob(**row) for row in failures),
        **sizes,
    )
