"""What is kept of ended jobs, and for how long. Each function runs in the caller's transaction."""

from __future__ import annotations

import logging

from workers.database.database import Connection
from workers.jobs.job_states import add_event
from workers.store.trash import discard

log = logging.getLogger(__name__)

# For checkpoints that a backup could not save: those jobs start over.
FORGET_CHECKPOINTS = "UPDATE jobs SET checkpoint = NULL WHERE checkpoint ->> 'prefix' = ANY (%s)"


async def date_jobs(connection: Connection, kept_s: float | None) -> None:
    """Set the dates of expiry: ``kept_s`` after the end of each job, or none."""
    await connection.execute(
        "UPDATE jobs SET expires_at = finished_at + make_interval(secs => %s)"
        " WHERE finished_at IS NOT NULL AND state <> 'expired'"
        " AND expires_at IS DISTINCT FROM finished_at + make_interval(secs => %s)",
        (kept_s, kept_s),
    )


async def expire_jobs(connection: Connection, limit: int) -> int:
    """Expire the results that are due, at most ``limit``; returns how many."""
    due = await connection.rows(
        "SELECT id, tenant, finished_at, artifacts FROM jobs WHERE expires_at <= clock_timestamp()"
        " AND state IN ('succeeded', 'failed', 'cancelled')"
        # An unfinished export or fork still reads the files.
        " AND NOT EXISTS (SELECT 1 FROM jobs AS heir WHERE jobs.id IN (heir.parent, heir.forked_from)"
        " AND heir.state IN ('queued', 'running'))"
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
        await add_event(connection, job["id"], "expired", freed)
        await discard(connection, f"jobs/{job['id']}")
        over = f"{job['finished_at']:%Y-%m-%d %H:%M} UTC"
        log.info("expired %s of %s, over since %s: %s", job["id"], job["tenant"], over, freed)
    return len(due)


async def drop_left_checkpoints(connection: Connection, stall_s: float) -> None:
    """Ended jobs need no checkpoint; versions before 007 left it in their rows, and sometimes its files."""
    left = await connection.rows(
        "UPDATE jobs SET checkpoint = NULL WHERE checkpoint IS NOT NULL AND state NOT IN ('queued', 'running')"
        " RETURNING id"
    )
    for job in left:
        await discard(connection, f"jobs/{job['id']}/checkpoints", after_s=2 * stall_s)


async def forget_keys(connection: Connection, kept_s: float) -> None:
    """Idempotency keys of jobs that ended so long ago can be used again."""
    await connection.execute(
        "UPDATE jobs SET idempotency_key = NULL WHERE idempotency_key IS NOT NULL"
        " AND finished_at < clock_timestamp() - make_interval(secs => %s)",
        (kept_s,),
    )


async def delete_expired_jobs(connection: Connection, kept_s: float) -> None:
    """Delete the records of jobs that expired so long ago."""
    await connection.execute(
        "DELETE FROM jobs WHERE state = 'expired'"
        " AND expires_at < clock_timestamp() - make_interval(secs => %s)",
        (kept_s,),
    )
