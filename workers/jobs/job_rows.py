"""Rows of the table `jobs`: public records, idempotency keys, and checks of their files."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from typing import Any

from psycopg.types.json import Jsonb

from biresnerf.options.refine_options import RefineOptions
from biresnerf.wire.jobs import JobEvent, JobProgress, JobTexts, JobUse, JobView
from workers.database.database import Connection
from workers.records import PREVIEW_FOLDER, THUMBNAIL_NAME, priority_name, record_from_row
from workers.settings.errors import Conflict, Expired

# Into how many a job has split itself; none for any other.
PARTS = """(SELECT jsonb_build_object('parts', count(*),
        'over', count(*) FILTER (WHERE part.state NOT IN ('queued', 'running')),
        'failed', count(*) FILTER (WHERE part.state NOT IN ('queued', 'running', 'succeeded')))
    FROM jobs AS part WHERE part.parent = jobs.id AND part.kind = 'refine' HAVING count(*) > 0) AS parts"""
JOB = f"""
    SELECT jobs.*, {PARTS}, CASE WHEN jobs.state = 'queued' AND NOT jobs.awaits_parts THEN
        (SELECT count(*) FROM jobs AS ahead WHERE ahead.state = 'queued' AND ahead.kind = jobs.kind
            AND NOT ahead.awaits_parts
            AND (ahead.queue_order, ahead.queue_id) <= (jobs.queue_order, jobs.queue_id))
        END AS queue_position
    FROM jobs"""
# The same for many jobs at once: counting for each takes seconds if thousands wait.
PLACES = """places AS (SELECT queue_id, row_number() OVER (PARTITION BY kind ORDER BY queue_order, queue_id)
    AS queue_position FROM jobs WHERE state = 'queued' AND NOT awaits_parts)"""
WHOLE_RESULT = ("poses.json", "report.json", "colmap/sparse/0/cameras.bin", "colmap/sparse/0/images.bin")
# The parameter is the store's tenant; None for all tenants.
MINE = "jobs.tenant = coalesce(%s, jobs.tenant)"


def job_from_row(row: dict[str, Any]) -> JobView:
    """The public record of a row of `JOB`."""
    return record_from_row(
        JobView,
        row,
        progress=record_from_row(JobProgress, row),
        use=record_from_row(JobUse, row),
        priority=priority_name(row["priority"]),
        thumbnail=_thumbnail(row),
    )


def require_files(row: Mapping[str, Any]) -> None:
    """Raises `Expired` if the job's files were deleted. A job that expired in the queue never had any."""
    if row["state"] == "expired" and row["started_at"] is not None:
        raise Expired(f"The files of job {row['id']} were kept for their time and are gone.")


def require_result(row: Mapping[str, Any]) -> None:
    """Raises `Expired` or `Conflict` (``result_not_ready``, ``state_conflict``) for a job without all its poses."""
    if row["kind"] != "refine":
        raise Conflict("state_conflict", f"{row['id']} is an export itself.")
    require_files(row)
    if row["state"] in ("queued", "running"):
        raise Conflict("result_not_ready", f"The job is {row['state']}.")
    names = {item["name"] for item in row["artifacts"]}
    if not names.issuperset(WHOLE_RESULT):
        raise Conflict("state_conflict", f"The job ended as {row['state']}, without a whole set of poses.")


def _thumbnail(row: dict[str, Any]) -> str | None:
    files = [*row["artifacts"], *(row["previews"] or {}).get("artifacts", [])]
    names = {item["name"] for item in files}
    return next(
        (name for name in (THUMBNAIL_NAME, f"{PREVIEW_FOLDER}/{THUMBNAIL_NAME}") if name in names), None
    )


def asked_columns(options: RefineOptions) -> dict[str, Any]:
    """The columns of a new job that follow from its options.

    Raises `InputError` (``invalid_options``) if they contradict the values of preset and method.
    """
    asked = options.model_dump(mode="json", exclude_unset=True)
    return {"options": Jsonb(asked), "planned_steps": options.resolved("cpu").steps}


async def jobs_of_dataset(connection: Connection, dataset_id: str) -> list[str]:
    """The id and state of each job on the dataset, as text."""
    jobs = await connection.rows("SELECT id, state FROM jobs WHERE dataset_id = %s", dataset_id)
    return [f"{job['id']} ({job['state']})" for job in jobs]


def fingerprint_of(subject: str, options: Mapping[str, Any], labels: Mapping[str, str] | None = None) -> str:
    """A digest of a request, which tells whether two requests with one idempotency key are the same."""
    request = json.dumps([subject, dict(options), dict(labels or {})], sort_keys=True)
    return hashlib.sha256(request.encode()).hexdigest()


def submission_fingerprint(subject: str, asked: JobTexts) -> str:
    """The fingerprint of a submission; ``subject`` is its dataset, or the digest of what was sent.

    Signed addresses differ each time, so they are not compared.
    """
    compared = asked.model_dump(mode="json", exclude_defaults=True, exclude={"dataset_id", "deliver"})
    return fingerprint_of(subject, compared)


async def known_job(
    connection: Connection, tenant: str, idempotency_key: str, fingerprint: str
) -> JobView | None:
    """The job of an earlier request with this key; raises `Conflict` if that was a different one."""
    row = await connection.row(JOB + " WHERE tenant = %s AND idempotency_key = %s", tenant, idempotency_key)
    if row is not None and row["fingerprint"] != fingerprint:
        raise Conflict("idempotency_key_reused", f"The key was used for another request ({row['id']}).")
    return None if row is None else job_from_row(row)


async def events_of(connection: Connection, job_id: str, after: int) -> tuple[JobEvent, ...]:
    """The job's history after ``seq == after``."""
    select = "SELECT seq, at, attempt, type, data FROM job_events WHERE job_id = %s AND seq > %s"
    rows = await connection.rows(f"{select} ORDER BY seq LIMIT 10000", job_id, after)
    return tuple(map(JobEvent.model_validate, rows))
