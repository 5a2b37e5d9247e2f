"""The figures of the whole installation for monitoring, read in one snapshot."""

from __future__ import annotations

from dataclasses import dataclass

from psycopg.rows import DictRow

from biresnerf.wire.datasets import DatasetState
from biresnerf.wire.jobs import JobState
from workers.database.database import Connection, Database


@dataclass(frozen=True)
class Statistics:
    """The installation at one moment.

    Attributes:
        queue: rows of the view ``queue_depth``: jobs that wait for a kind of slot, and that run on one.
        slots: rows (kind, busy, slots): living slots of a kind that run a refinement, and that run none; exports do not
            count.
        bounds_s: the bounds of the duration buckets.
        tallies: rows (name, label, bucket, count, amount): how often something happened, and the sum of its amounts.
            They never decrease. Durations have a bucket, all else is in bucket 0.
    """

    jobs: dict[JobState, int]
    datasets: dict[DatasetState, int]
    queue: list[DictRow]
    slots: list[DictRow]
    trash: int
    webhooks_pending: int
    webhooks_late_s: float
    bounds_s: list[float]
    tallies: list[DictRow]


LIVING = """slots JOIN queue_workers AS worker ON worker.id = slots.worker_id
    AND worker.last_heartbeat > now() - make_interval(secs => %s)"""
_SLOTS = f"""
    SELECT slots.kind,
        EXISTS (SELECT FROM queue_entries AS entry JOIN running_jobs AS job ON job.queue_id = entry.id
            WHERE entry.worker_id = worker.id AND entry.state = 'doing' AND job.kind = 'refine') AS busy,
        count(*) AS slots
    FROM {LIVING} GROUP BY 1, 2"""
_TALLIES = """
    SELECT name, label, bucket, sum(count)::bigint AS count, sum(amount) AS amount FROM (
        SELECT name, label, bucket, count, amount FROM tallies
        UNION ALL SELECT name, label, bucket, 1, amount FROM tally_log) AS counted
    GROUP BY 1, 2, 3 ORDER BY 1, 2, 3"""
_WEBHOOKS = """
    SELECT count(*) AS pending,
        greatest(coalesce(extract(epoch FROM clock_timestamp() - min(due_at)), 0), 0)::float8 AS late_s
    FROM webhook_deliveries WHERE state = 'pending'"""


async def read_statistics(database: Database, stall_s: float) -> Statistics:
    """Everything in one snapshot; raises `Unavailable`."""
    async with database.transaction() as connection:
        await connection.execute("SET TRANSACTION ISOLATION LEVEL REPEATABLE READ READ ONLY")
        jobs = await connection.rows("SELECT state, jobs FROM job_counts")
        datasets = await connection.rows("SELECT state, count(*) AS n FROM datasets GROUP BY state")
        (trash,) = await connection.rows("SELECT count(*) AS n FROM trash")
        (webhooks,) = await connection.rows(_WEBHOOKS)
        (bounds,) = await connection.rows("SELECT tally_bounds() AS bounds_s")
        return Statistics(
            jobs={row["state"]: row["jobs"] for row in jobs},
            datasets={row["state"]: row["n"] for row in datasets},
            queue=await connection.rows("SELECT * FROM queue_depth"),
            slots=await connection.rows(_SLOTS, stall_s),
            trash=trash["n"],
            webhooks_pending=webhooks["pending"],
            webhooks_late_s=webhooks["late_s"],
            bounds_s=bounds["bounds_s"],
            tallies=await connection.rows(_TALLIES),
        )


async def fold_tallies(connection: Connection) -> None:
    """Sums up the single counts, in the caller's transaction; one caller at a time."""
    await connection.execute(
        "WITH taken AS (DELETE FROM tally_log RETURNING name, label, bucket, amount)"
        " INSERT INTO tallies (name, label, bucket, count, amount)"
        " SELECT name, label, bucket, count(*), sum(amount) FROM taken GROUP BY 1, 2, 3 ORDER BY 1, 2, 3"
        " ON CONFLICT (name, label, bucket) DO UPDATE SET"
        " count = tallies.count + excluded.count, amount = tallies.amount + excluded.amount"
    )


async def fold_use(connection: Connection) -> None:
    """Sums up the records of single attempts."""
    await connection.execute(
        "WITH taken AS (DELETE FROM use_records WHERE (day, tenant, key_id, device) IN ("
        " SELECT day, tenant, key_id, device FROM use_records GROUP BY 1, 2, 3, 4 HAVING count(*) > 1) RETURNING *)"
        " INSERT INTO use_records SELECT day, tenant, key_id, device, sum(attempts), sum(processor_s), sum(wall_s)"
        " FROM taken GROUP BY 1, 2, 3, 4"
    )


async def announce_slot(database: Database, host: str, name: str, worker_id: int) -> None:
    """Records a slot's worker id in the queue; deletes slots that are gone."""
    async with database.transaction() as connection:
        await connection.execute(
            "DELETE FROM slots WHERE NOT EXISTS (SELECT FROM queue_workers WHERE id = slots.worker_id)"
        )
        await connection.execute(
            "INSERT INTO slots (host, name, worker_id) VALUES (%s, %s, %s)"
            " ON CONFLICT (host, name) DO UPDATE SET worker_id = excluded.worker_id",
            (host, name, worker_id),
        )
