"""Every change of a job's state, from its submission to its end.

Each function runs in the caller's transaction. To end a job, the caller must hold its row lock.
"""

from __future__ import annotations

import logging
import uuid
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

from psycopg import sql
from psycopg.types.json import Jsonb

from biresnerf.stages import REUSABLE_STAGES
from biresnerf.wire.jobs import EventType
from biresnerf.wire.problems import JobError
from workers.database import job_queue
from workers.database.database import Connection
from workers.database.ids import new_id
from workers.jobs.setbacks import SETBACKS, Cause
from workers.records import LOG_NAME, POSES_NAME, PREVIEW_FOLDER, REPORT_NAME, Artifact
from workers.settings.traces import traceparent
from workers.store.trash import discard

log = logging.getLogger(__name__)

End = Literal["succeeded", "failed", "cancelled", "expired"]


async def add_event(
    connection: Connection, job_id: str, event: EventType, data: Mapping[str, Any] | None = None
) -> None:
    """Append to the job's history, and wake its subscribers."""
    await connection.execute("SELECT add_job_event(%s, %s, %s)", (job_id, event, Jsonb(dict(data or {}))))


async def insert_job(connection: Connection, values: Mapping[str, Any]) -> dict[str, Any]:
    """Insert a new job, ``values`` by column; pass the returned row to `queue_job`."""
    row = {**values, "trace": traceparent()}
    statement = sql.SQL("INSERT INTO jobs ({}) VALUES ({}) RETURNING id, kind, queue_order, held").format(
        sql.SQL(", ").join(map(sql.Identifier, row)), sql.SQL(", ").join([sql.Placeholder()] * len(row))
    )
    return await connection.only_row(statement, *row.values())


async def queue_job(connection: Connection, job: Mapping[str, Any]) -> None:
    """Put a new job into the queue at its tenant's turn."""
    await _enqueue(connection, job)
    await add_event(connection, job["id"], "queued")


async def split_job(connection: Connection, job_id: str, parts: Sequence[Mapping[str, Any]]) -> None:
    """Queue a job with each of these options below a running job, which is held in the queue until all are over."""
    whole = await connection.only_row("SELECT * FROM jobs WHERE id = %s", job_id)
    await requeue(connection, job_id, Requeue("split", {"parts": len(parts)}))
    await connection.execute("UPDATE jobs SET awaits_parts = true, held = true WHERE id = %s", (job_id,))
    await _enqueue(connection, {**whole, "held": True})
    same = {name: whole[name] for name in ("tenant", "dataset_id", "priority", "key_id", "planned_steps")}
    title = whole["labels"].get("name")
    for number, options in enumerate(parts, start=1):
        part = f"part {number} of {len(parts)}"
        values = {
            **same,
            "id": new_id("job"),
            "parent": job_id,
            "options": Jsonb(dict(options)),
            "labels": Jsonb({"name": f"{title}, {part}" if title else part}),
            "fingerprint": f"{part} of {job_id}",
        }
        await queue_job(connection, await insert_job(connection, values))
    await _tell_whole(connection, job_id)


async def _tell_whole(connection: Connection, job_id: str) -> None:
    """Show how many parts of a split job are over, and offer it if none is left."""
    counted = await connection.only_row(
        "SELECT count(*) AS parts, count(*) FILTER (WHERE state NOT IN ('queued', 'running')) AS over"
        " FROM jobs WHERE parent = %s AND kind = 'refine'",
        job_id,
    )
    waits = bool(counted["over"] < counted["parts"])
    await connection.execute(
        "UPDATE jobs SET awaits_parts = %s, message = %s WHERE id = %s",
        (waits, f"{counted['over']} of {counted['parts']} parts are over" if waits else "", job_id),
    )
    if counted["over"]:
        await add_event(connection, job_id, "part_over", counted)
    if not waits:
        await connection.execute("SELECT offer_held(tenant) FROM jobs WHERE id = %s", (job_id,))


async def cancel_part_of_ended(connection: Connection, stall_s: float) -> bool:
    """Cancel one part of a job that has ended without waiting for it; False if there is none."""
    part = await connection.row(
        "SELECT part.id FROM jobs AS part JOIN jobs AS whole ON whole.id = part.parent"
        " WHERE part.kind = 'refine' AND part.state IN ('queued', 'running') AND NOT part.cancel_requested"
        " AND whole.state NOT IN ('queued', 'running') LIMIT 1 FOR UPDATE OF part SKIP LOCKED"
    )
    if part is None:
        return False
    await request_cancel(connection, part["id"], None, False, stall_s)
    return True


async def _enqueue(connection: Connection, job: Mapping[str, Any]) -> None:
    entry_id = await job_queue.enqueue(
        connection, job["id"], job["kind"], order=job["queue_order"], held=job["held"]
    )
    await connection.execute("UPDATE jobs SET queue_id = %s WHERE id = %s", (entry_id, job["id"]))


async def start_attempt(connection: Connection, job_id: str, token: uuid.UUID) -> dict[str, Any]:
    """Start a new attempt, which then owns the job; returns the row."""
    row = await connection.only_row(
        "UPDATE jobs SET state = 'running', attempt = attempt + 1, run_token = %s, fraction = 0,"
        " slot_kind = (SELECT slots.kind FROM queue_entries AS entry JOIN slots USING (worker_id)"
        " WHERE entry.id = jobs.queue_id),"
        " attempt_started_at = clock_timestamp(), attempt_seen_at = clock_timestamp(), attempt_processor_s = 0,"
        " step = 0, steps_total = 0, stage = NULL, eta_s = NULL, message = '',"
        " started_at = coalesce(started_at, clock_timestamp()) WHERE id = %s RETURNING *",
        token,
        job_id,
    )
    await add_event(connection, job_id, "started", {"resumed": row["checkpoint"] is not None})
    return row


async def drop_token(connection: Connection, job_id: str) -> None:
    """Fence the current attempt: it can write no more, and its use counts until it was last seen."""
    await connection.execute("UPDATE jobs SET run_token = NULL WHERE id = %s", (job_id,))


@dataclass(frozen=True)
class Requeue:
    """Why a job goes back to the queue: the event, and what changes.

    Attributes:
        setback: what ended the attempt; None if nothing went wrong: then the attempt does not count.
        fence: drop the token, so that the old attempt can write no more.
        forget_checkpoint: start over.
        smaller: options that later attempts use in place of the requested ones.
    """

    event: EventType
    data: Mapping[str, Any]
    setback: Cause | None = None
    fence: bool = False
    forget_checkpoint: bool = False
    smaller: Mapping[str, Any] = field(default_factory=dict)


async def requeue(connection: Connection, job_id: str, how: Requeue) -> None:
    """Set the job back to queued. The caller puts its queue entry back.

    A setback counts only if an attempt was running: not before it began or after it gave the job back.
    """
    setback = None if how.setback is None else SETBACKS[how.setback]
    counts = setback and setback.counts
    await connection.execute(
        "UPDATE jobs SET state = 'queued', attempt = attempt - %s,"
        " crashes = crashes + CASE WHEN state = 'running' THEN %s ELSE 0 END,"
        " losses = losses + CASE WHEN state = 'running' THEN %s ELSE 0 END,"
        " setback = CASE WHEN state = 'running' THEN %s ELSE setback END,"
        " message = %s, eta_s = NULL, run_token = CASE WHEN %s THEN NULL ELSE run_token END,"
        " checkpoint = CASE WHEN %s THEN NULL ELSE checkpoint END, smaller = smaller || %s WHERE id = %s",
        (
            *(int(setback is None), int(counts == "crash"), int(counts == "loss"), how.setback),
            *(setback.message if setback else "", how.fence, how.forget_checkpoint),
            *(Jsonb(dict(how.smaller)), job_id),
        ),
    )
    await add_event(connection, job_id, how.event, how.data)


async def say_what_it_waits_for(connection: Connection, job_id: str, cause: Cause) -> None:
    """Tell the owner of a queued job, once, why it does not start."""
    message = SETBACKS[cause].message
    changed = await connection.execute(
        "UPDATE jobs SET message = %s, revision = revision + 1, updated_at = clock_timestamp()"
        " WHERE id = %s AND state = 'queued' AND message <> %s",
        (message, job_id, message),
    )
    if changed.rowcount:
        await connection.execute("SELECT pg_notify('biresnerf_jobs', %s)", (job_id,))


async def take_back(connection: Connection, entry_id: int, stall_s: float) -> None:
    """Take a queue entry back from a dead worker.

    The job is requeued (its attempt stays counted); a cancelled or final one leaves the queue. The token is dropped, so
    a worker that was only suspended is fenced.
    """
    job = await connection.row(  # only unfinished jobs are indexed
        "SELECT id, cancel_requested FROM jobs"
        " WHERE queue_id = %s AND state IN ('queued', 'running') FOR UPDATE",
        entry_id,
    )
    if not await job_queue.lock_taken(connection, entry_id, None):
        return  # the entry has ended meanwhile
    if job is None:  # or final
        await job_queue.abort(connection, entry_id)
        return
    log.warning("taking job %s back: its worker is gone", job["id"])
    if job["cancel_requested"]:
        await connection.execute("UPDATE jobs SET run_token = NULL WHERE id = %s", (job["id"],))
        await finish_cancelled(connection, job["id"], stall_s)
        await job_queue.abort(connection, entry_id)
        return
    await requeue(
        connection, job["id"], Requeue("requeued", {"why": "worker_lost"}, "worker_lost", fence=True)
    )
    await job_queue.put_back(connection, entry_id)


async def requeue_lost(connection: Connection, silent_s: float) -> None:
    """Requeue unfinished jobs whose queue entry is gone, if they have not changed for ``silent_s``."""
    for job in await connection.rows(
        "SELECT jobs.id, jobs.kind, jobs.queue_order, jobs.held"
        " FROM jobs LEFT JOIN queue_entries AS entry ON entry.id = jobs.queue_id"
        " WHERE jobs.state IN ('queued', 'running')"
        " AND jobs.updated_at < clock_timestamp() - make_interval(secs => %s)"
        " AND coalesce(entry.state NOT IN ('todo', 'doing'), true) FOR UPDATE OF jobs SKIP LOCKED",
        silent_s,
    ):
        log.warning("job %s was lost by the queue; queueing it again", job["id"])
        await _enqueue(connection, job)
        await requeue(connection, job["id"], Requeue("requeued", {"why": "lost"}, "worker_lost", fence=True))


async def offer_held_jobs(connection: Connection) -> None:
    """Offer held jobs as far as limits allow. The end of a job does so anyway; call this after limits changed."""
    await connection.execute(
        "SELECT offer_held(tenant)"
        " FROM (SELECT DISTINCT tenant FROM jobs WHERE held AND state = 'queued') AS waiting"
    )


async def request_cancel(
    connection: Connection,
    job_id: str,
    tenant: str | None,
    keep_partial: bool,
    stall_s: float,
    why: JobError | None = None,
) -> None:
    """Cancel a queued job, or ask its worker to. Does nothing if that was requested before or the job has ended.

    ``why`` becomes its error; None if its user asks.
    """
    job = await connection.row(
        "UPDATE jobs SET cancel_requested = true, keep_partial = %s, error = %s"
        " WHERE id = %s AND tenant = coalesce(%s, tenant) AND state IN ('queued', 'running')"
        " AND NOT cancel_requested RETURNING queue_id, state",
        *(keep_partial, _error_column(why), job_id, tenant),
    )
    if job is None:
        return
    await job_queue.cancel(connection, job["queue_id"])
    if job["state"] == "queued":  # maybe after an attempt that published previews
        await finish_cancelled(connection, job_id, stall_s)
    else:
        await add_event(connection, job_id, "cancel_requested", {"code": why.code} if why else {})


async def delete_job(connection: Connection, job_id: str) -> None:
    """Delete a final job with its exports and all their files."""
    await connection.execute("DELETE FROM jobs WHERE id = %s", (job_id,))
    await connection.execute("SELECT pg_notify('biresnerf_jobs', %s)", (job_id,))


async def finish(
    connection: Connection,
    job_id: str,
    state: End,
    error: JobError | None,
    artifacts: Sequence[Artifact] = (),
    *,
    partial: bool = False,
) -> None:
    """Record the end of a job, and its event. Parts that end later add none to it.

    Drops previews and checkpoints; `trash_attempts` deletes their files.
    """
    await connection.execute(
        "UPDATE jobs SET state = %s, error = %s, artifacts = %s, finished_at = clock_timestamp(),"
        " eta_s = NULL, fraction = CASE WHEN %s = 'succeeded' THEN 1 ELSE fraction END,"
        " expires_at = CASE WHEN %s = 'expired' THEN clock_timestamp() ELSE expires_at END,"
        " partial = %s, previews = NULL, checkpoint = NULL, awaits_parts = false WHERE id = %s",
        (
            *(state, _error_column(error)),
            *(Jsonb([item.model_dump() for item in artifacts]), state, state, partial, job_id),
        ),
    )
    data: dict[str, Any] = {"code": error.code, "detail": error.detail} if error else {}
    if state == "cancelled":
        data["partial"] = partial
    await add_event(connection, job_id, state, data)
    # The last of two parts that end at once sees the end of the other, as it waits for this lock.
    whole = await connection.row(
        "SELECT whole.id FROM jobs AS whole JOIN jobs AS part ON part.parent = whole.id"
        " WHERE part.id = %s AND part.kind = 'refine' AND whole.awaits_parts FOR UPDATE OF whole",
        job_id,
    )
    if whole is not None:
        await _tell_whole(connection, whole["id"])


def _error_column(error: JobError | None) -> Jsonb | None:
    return Jsonb(error.model_dump()) if error else None


async def finish_cancelled(
    connection: Connection,
    job_id: str,
    stall_s: float,
    artifacts: Sequence[Artifact] = (),
    keep: str | None = None,
) -> None:
    """End a job on request or at its deadline, keeping the files that are wanted: all, or the log alone.

    If a partial result is wanted but was not written, the last preview takes its place.

    Args:
        stall_s: how long a worker may be silent; files are deleted after twice that.
        artifacts: what the attempt could store.
        keep: the attempt's name.
    """
    row = await connection.only_row("SELECT keep_partial, previews, error FROM jobs WHERE id = %s", job_id)
    logs = [item for item in artifacts if item.name == LOG_NAME]
    kept, shown = list(artifacts), None
    if row["keep_partial"] and not is_whole(kept) and row["previews"] is not None:
        shown = row["previews"]["prefix"].rpartition("/")[2]
        kept = logs + [
            item.model_copy(update={"name": item.name.removeprefix(f"{PREVIEW_FOLDER}/")})
            for item in map(Artifact.model_validate, row["previews"]["artifacts"])
        ]
    partial = row["keep_partial"] and is_whole(kept)
    why = JobError.model_validate(row["error"]) if row["error"] else None
    await finish(connection, job_id, "cancelled", why, kept if partial else logs, partial=partial)
    await trash_attempts(connection, job_id, stall_s, keep, preview=shown)


def is_whole(artifacts: Sequence[Artifact]) -> bool:
    """Whether there are poses and a report. The report is written last, so a killed process may lack it."""
    return {POSES_NAME, REPORT_NAME} <= {item.name for item in artifacts}


async def trash_attempts(
    connection: Connection,
    job_id: str,
    stall_s: float,
    keep: str | None = None,
    *,
    preview: str | None = None,
) -> None:
    """Move to the trash what attempts left.

    Keeps the results of ``keep``, the preview named ``preview``, and the stages' work that the job records.
    """
    row = await connection.only_row("SELECT reusable FROM jobs WHERE id = %s", job_id)
    kept = {"checkpoints": None, "results": keep, "previews": preview}
    for stage in REUSABLE_STAGES:
        recorded = row["reusable"].get(stage)
        kept[f"stages/{stage}"] = recorded and recorded["prefix"].rpartition("/")[2]
    # Twice the stall time: a frozen owner that wakes up later finds itself fenced at its first write.
    for folder, name in kept.items():
        await discard(connection, f"jobs/{job_id}/{folder}", after_s=2 * stall_s, keep=name)
