"""Deadlines of jobs: set at submission, enforced by the janitor and when a job is claimed.

The clock is the database's.
"""

from __future__ import annotations

from collections.abc import Mapping
from datetime import UTC, datetime
from typing import Any

from biresnerf.errors import InputError
from biresnerf.wire.jobs import DEADLINE_MOST_S, JobTexts
from biresnerf.wire.problems import JobError
from workers.database import job_queue
from workers.database.database import Connection
from workers.jobs.job_states import finish, request_cancel

# For unfinished jobs. After the start, only the deadline counts.
OVERDUE = "(start_by <= clock_timestamp() AND (started_at IS NULL OR deadline_at <= clock_timestamp()))"
MOST_AT_ONCE = 200


async def limit_columns(connection: Connection, asked: JobTexts) -> dict[str, datetime | None]:
    """The columns with the time limits of a job that is submitted now.

    Raises `InputError` (``deadline_refused``) for a deadline that has passed, or is too far ahead.
    """
    if asked.expires_in_queue_s is None and asked.deadline_at is None:
        return {}
    row = await connection.only_row(
        # Python cannot represent some of PostgreSQL's times, so none of them is returned.
        "SELECT greatest(now, least(deadline, now + make_interval(secs => %s))) AS start_by,"
        " deadline <= now AS passed, deadline > now + make_interval(secs => %s) AS far, now"
        " FROM (SELECT clock_timestamp() AS now, %s::timestamptz AS deadline) AS at",
        *(asked.expires_in_queue_s or DEADLINE_MOST_S, DEADLINE_MOST_S, asked.deadline_at),
    )
    if row["passed"] or row["far"]:
        wrong = "has passed" if row["passed"] else f"is more than {DEADLINE_MOST_S // 86_400} days ahead"
        raise InputError(
            "deadline_refused",
            f"The deadline {wrong}: it is {_written(row['now'])} now.",
            where="deadline_at",
        )
    return {"start_by": row["start_by"], "deadline_at": asked.deadline_at}


async def end_overdue_jobs(connection: Connection, stall_s: float) -> list[str]:
    """End at most `MOST_AT_ONCE` overdue jobs, waiting or running; returns their ids."""
    overdue = await connection.rows(
        # Compare with now() first, which can use the index.
        "SELECT * FROM jobs WHERE state IN ('queued', 'running') AND start_by <= now()"
        f" AND NOT cancel_requested AND {OVERDUE} ORDER BY start_by LIMIT %s FOR UPDATE SKIP LOCKED",
        MOST_AT_ONCE,
    )
    for job in overdue:
        await end_overdue(connection, job, stall_s)
    return [job["id"] for job in overdue]


async def end_overdue(connection: Connection, job: Mapping[str, Any], stall_s: float) -> None:
    """End an overdue job, whose row the caller has locked.

    One that never started expires. Any other is cancelled and keeps its best poses so far, if it has published any: a
    running one through its worker, a requeued one at once.
    """
    if job["started_at"] is None:
        await job_queue.cancel(connection, job["queue_id"])
        late = f"The job had not started by {_written(job['start_by'])}."
        hint = "Submit it again with more time, or when fewer jobs wait."
        await finish(
            connection, job["id"], "expired", JobError(code="deadline_passed", detail=late, hint=hint)
        )
        return
    late = f"The job was stopped at its deadline, {_written(job['deadline_at'])}."
    error = JobError(
        code="deadline_passed", detail=late, hint="Submit it again with more time, or ask for less."
    )
    await request_cancel(connection, job["id"], None, True, stall_s, error)


def _written(at: datetime) -> str:
    return f"{at.astimezone(UTC):%Y-%m-%dT%H:%M:%SZ}"
