"""Expiry of ended jobs and their data. Each function runs in the caller's transaction.

Dates are compared with now(): clock_timestamp() is volatile, so it cannot use an index.
"""

from __future__ import annotations

import logging
from datetime import datetime

from workers.database.database import Connection
from workers.jobs.job_states import add_event
from workers.store.trash import discard

log = logging.getLogger(__name__)

# For checkpoints that a backup could not save: those jobs start over.
FORGET_CHECKPOINTS = "UPDATE jobs SET checkpoint = NULL WHERE checkpoint ->> 'prefix' = ANY (%s)"


async def date_jobs(connection: Connection, kept_s: float | None) -> None:
    """Set the expiry dates of all jobs: ``kept_s`` after the end of each, or none."""
    await connection.execute(
        "UPDATE jobs SET expires_at = finished_at + make_interval(secs => %s)"
        " WHERE finished_at IS NOT NULL AND state <> 'expired'"
        " AND expires_at IS DISTINCT FROM finished_at + make_interval(secs => %s)",
        (kept_s, kept_s),
    )


async def date_new_jobs(connection: Connection, kept_s: float | None) -> None:
    """Set the expiry dates of jobs that ended since the last call."""
    if kept_s is not None:
        await connection.execute(
            "UPDATE jobs SET expires_at = finished_at + make_interval(secs => %s)"
            " WHERE finished_at IS NOT NULL AND expires_at IS NULL AND state <> 'expired'",
            (kept_s,),
        )


async def datasets_used_since(connection: Connection, since: datetime) -> list[str]:
    """Datasets with a job that was submitted or ended after ``since``."""
    rows = await connection.rows(
        "SELECT dataset_id FROM jobs WHERE created_at > %s"
        " UNION SELECT dataset_id FROM jobs WHERE finished_at > %s",
        *(since, since),
    )
    return [row["dataset_id"] for row in rows]


async def expire_jobs(connection: Connection, limit: int) -> int:
    """Expire the results that are due, at most ``limit``; returns how many."""
    due = await connection.rows(
        "SELECT id, tenant, finished_at, artifacts FROM jobs WHERE expires_at <= now()"
        " AND state IN ('succeeded', 'failed', 'cancelled')"
        # An unfinished export, fork or job that joins it, or that it is a part of, still reads the files.
        " AND NOT EXISTS (SELECT 1 FROM jobs AS export WHERE export.parent = jobs.id"
        " AND export.state IN ('queued', 'running'))"
        " AND NOT EXISTS (SELECT 1 FROM jobs AS fork WHERE fork.forked_from = jobs.id"
        " AND fork.state IN ('queued', 'running'))"
        " AND NOT EXISTS (SELECT 1 FROM jobs AS joined WHERE joined.fixed_from = jobs.id"
        " AND joined.state IN ('queued', 'running'))"
        " AND NOT EXISTS (SELECT 1 FROM jobs AS whole WHERE whole.id = jobs.parent"
        " AND whole.state IN ('queued', 'running'))"
        " ORDER BY expires_at LIMIT %s FOR UPDATE SKIP LOCKED",
        limit,
    )
    for job in due:
        freed = {"files": len(job["artifacts"]), "bytes": sum(item["size"] for item in job["artifacts"])}
        await connection.execute(
            "UPDATE jobs SET state = 'expired', artifacts = '[]', checkpoint = NULL, previews = NULL,"
            " reusable = '{}' WHERE id = %s",
            (job["id"],),
        )
        await add_event(connection, job["id"], "files_expired", freed)
        await discard(connection, f"jobs/{job['id']}")
        over = f"{job['finished_at']:%Y-%m-%d %H:%M} UTC"
        log.info("expired %s of %s, over since %s: %s", job["id"], job["tenant"], over, freed)
    return len(due)


async def drop_left_checkpoints(connection: Connection, stall_s: float) -> None:
    """Drop checkpoints of ended jobs: versions before 007 left them in rows, and sometimes their files."""
    left = await connection.rows(
        "UPDATE jobs SET checkpoint = NULL WHERE checkpoint IS NOT NULL AND state NOT IN ('queued', 'running')"
        " RETURNING id"
    )
    for job in left:
        await discard(connection, f"jobs/{job['id']}/checkpoints", after_s=2 * stall_s)


async def forget_keys(connection: Connection, kept_s: float) -> None:
    """Release the idempotency keys of jobs and batches that ended so long ago."""
    for sql in ("UPDATE jobs SET idempotency_key = NULL", "UPDATE batches SET idempotency_key = NULL"):
        await connection.execute(
            f"{sql} WHERE idempotency_key IS NOT NULL AND finished_at < now() - make_interval(secs => %s)",
            (kept_s,),
        )


async def delete_expired_jobs(connection: Connection, kept_s: float) -> None:
    """Delete the records of jobs that expired so long ago."""
    await connection.execute(
        "DELETE FROM jobs WHERE state = 'expired' AND expires_at < now() - make_interval(secs => %s)",
        (kept_s,),
    )
