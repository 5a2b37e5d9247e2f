"""A row of the table `jobs` as the record that clients see."""

from __future__ import annotations

from typing import Any

from workers.records import Job, JobError, JobProgress

JOB = """
    SELECT jobs.*, CASE WHEN jobs.state = 'queued' THEN
        (SELECT count(*) FROM jobs AS ahead WHERE ahead.state = 'queued' AND ahead.queue_id <= jobs.queue_id)
        END AS queue_position
    FROM jobs"""
# With the store's tenant as parameter; none for everybody's.
MINE = "jobs.tenant = coalesce(%s, jobs.tenant)"


def job_from_row(row: dict[str, Any]) -> Job:
    """The public record of a row of `JOB`."""
    same = (
        "id",
        "tenant",
        "dataset_id",
        "state",
        "stage",
        "queue_position",
        "attempt",
        "cancel_requested",
        "created_at",
    )
    also = ("started_at", "finished_at", "options", "metrics", "message", "verdict", "labels", "revision")
    life = ("expires_at", "kind", "parent", "forked_from", "forked_stage", "smaller", "partial")
    progress = JobProgress(**{key: row[key] for key in ("fraction", "step", "steps_total", "eta_s")})
    error = JobError.model_validate(row["error"]) if row["error"] else None
    return Job(**{key: row[key] for key in same + also + life}, progress=progress, error=error)
