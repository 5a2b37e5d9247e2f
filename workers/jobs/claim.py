"""Claims a job: from then on, only the attempt that holds the token (the fence) can write into it."""

from __future__ import annotations

import uuid
from dataclasses import dataclass, fields
from typing import Any

from biresnerf.stages import ReusableStage
from biresnerf.wire.jobs import JobKind
from workers.database import job_queue
from workers.database.database import Database
from workers.jobs.deadlines import OVERDUE, end_overdue
from workers.jobs.job_states import drop_token, finish, finish_cancelled, start_attempt, trash_attempts
from workers.jobs.setbacks import crashed_too_often, used_up
from workers.process.waiting import retry_while_unavailable
from workers.settings.errors import NotFound


class Fenced(BaseException):
    """Another attempt has claimed the job since. Not an `Exception`: no handler may swallow it."""


@dataclass(frozen=True)
class Claim:
    """One attempt of one job, owned by whoever holds ``token``.

    ``options`` are as requested; the job's process resolves them for its device. ``title`` heads the report.
    """

    job_id: str
    dataset_id: str
    attempt: int
    token: uuid.UUID
    kind: JobKind
    parent: str | None
    fixed_from: str | None
    part_photos: int | None
    options: dict[str, Any]
    smaller: dict[str, Any]
    checkpoint: dict[str, Any] | None
    reusable: dict[str, Any]
    forked_stage: ReusableStage | None
    trace: str | None
    title: str | None

    @property
    def name(self) -> str:
        """The attempt's folder name, unique among all attempts."""
        return f"{self.attempt}-{self.token.hex[:8]}"


async def claim_job(
    database: Database, job_id: str, worker_id: int, max_attempts: int, stall_s: float
) -> Claim | None:
    """Claim a job with a fresh token, for the worker that holds its queue entry; None if there is nothing to run.

    A worker that wakes up after it counted as dead finds the entry back in the queue, or held by another worker. A job
    whose cancellation was requested ends ``cancelled``, one that has used up its attempts ``failed``, and an overdue
    one as `end_overdue` says.
    """
    token = uuid.uuid4()
    return await retry_while_unavailable(
        lambda: _claim(database, job_id, worker_id, max_attempts, stall_s, token)
    )


async def _claim(
    database: Database, job_id: str, worker_id: int, max_attempts: int, stall_s: float, token: uuid.UUID
) -> Claim | None:
    async with database.transaction() as connection:
        sql = f"SELECT *, {OVERDUE} AS overdue FROM jobs WHERE id = %s FOR UPDATE"
        row = await connection.row(sql, job_id)
        if row is not None and row["run_token"] == token:
            # An earlier try was committed and only its acknowledgement lost: the attempt counts once.
            return _claimed(row, token)
        if row is None or row["state"] not in ("queued", "running") or row["awaits_parts"]:
            return None
        if not await job_queue.lock_taken(connection, row["queue_id"], worker_id):
            return None
        if row["state"] == "running":  # the end of its last attempt was never recorded
            await drop_token(connection, job_id)
        if row["overdue"] and not row["cancel_requested"]:
            await end_overdue(connection, row, stall_s)
        # No worker runs it, even if the row says so.
        if row["cancel_requested"] or (row["overdue"] and row["state"] == "running"):
            await finish_cancelled(connection, job_id, stall_s)
        if row["cancel_requested"] or row["overdue"]:
            return None
        if used_up(row["attempt"], row["crashes"], row["losses"], max_attempts):
            await finish(connection, job_id, "failed", crashed_too_often(row["attempt"], row["setback"]))
            await trash_attempts(connection, job_id, stall_s)
            return None
        return _claimed(await start_attempt(connection, job_id, token), token)


def _claimed(row: dict[str, Any], token: uuid.UUID) -> Claim:
    named = {field.name: row[field.name] for field in fields(Claim) if field.name in row}
    return Claim(**named, job_id=row["id"], token=token, title=row["labels"].get("name"))


async def cancel_requested(database: Database, job_id: str) -> bool:
    """Whether the job's user wants it to end."""
    return bool(await database.fetch("SELECT 1 FROM jobs WHERE id = %s AND cancel_requested", job_id))


async def input_bytes(database: Database, job_id: str) -> int:
    """The size of the files that an attempt stages."""
    (row,) = await database.fetch(
        "SELECT coalesce(sum(file.size), 0)::bigint AS bytes FROM jobs"
        " JOIN dataset_files AS file ON file.dataset_id = jobs.dataset_id WHERE jobs.id = %s",
        job_id,
    )
    return int(row["bytes"])


async def published_files(database: Database, job_id: str) -> list[tuple[str, str]]:
    """The key and name of each file of a job's result; raises `NotFound`."""
    rows = await database.fetch("SELECT artifacts FROM jobs WHERE id = %s", job_id)
    if not rows:
        raise NotFound(f"No job {job_id}.")
    return [(item["key"], item["name"]) for item in rows[0]["artifacts"]]


async def parts_of(database: Database, job_id: str) -> list[dict[str, Any]]:
    """State, artifacts, error and options of each part of a job that has split itself, in order; else none."""
    return await database.fetch(
        "SELECT state, artifacts, error, options FROM jobs WHERE parent = %s AND kind = 'refine'"
        " ORDER BY created_at, id",
        job_id,
    )
