"""The writes of a running attempt into its job, each fenced by the attempt's token.

If two processes believe that they run a job (one was frozen and counted as dead), only the later claim can write. The
other gets `Fenced` and must exit without touching the queue.
"""

from __future__ import annotations

import functools
from collections.abc import Awaitable, Callable, Coroutine, Mapping, Sequence
from typing import Any, Concatenate, Literal, ParamSpec, TypeAlias, TypeVar

from psycopg import sql
from psycopg.rows import DictRow
from psycopg.types.json import Jsonb

from biresnerf.progress import Progress
from biresnerf.report import VerdictName
from biresnerf.stages import ReusableStage
from biresnerf.wire.jobs import EventType
from biresnerf.wire.problems import JobError
from workers.database.database import Connection, Database
from workers.jobs.claim import Claim, Fenced
from workers.jobs.job_states import (
    Requeue,
    add_event,
    finish,
    finish_cancelled,
    requeue,
    split_job,
    trash_attempts,
)
from workers.process.waiting import retry_while_unavailable
from workers.records import LOG_NAME, Artifact
from workers.store.trash import discard

PREVIEW_KEPT_S = 60.0  # after it was replaced: it may be downloading
LOG_LINES_MAX = 20_000  # of one job
EVENTS_MAX = 10_000  # of one job, except those of attempts and the end, which are few
_LOCKED = """
    SELECT id, run_token, state, stage, cancel_requested, keep_partial, log_lines, checkpoint, reusable, previews,
    crashes, seq
    FROM jobs WHERE id = %s FOR UPDATE"""
P = ParamSpec("P")
T = TypeVar("T")
_Write: TypeAlias = Callable[Concatenate["Ledger", Connection, DictRow, P], Awaitable[T]]
_Fenced: TypeAlias = Callable[Concatenate["Ledger", P], Coroutine[Any, Any, T]]


def _fenced(done: Callable[[DictRow], T]) -> Callable[[_Write[P, T]], _Fenced[P, T]]:
    """Runs a method of `Ledger` with the job's row, locked, if the token is still valid.

    Waits while the database is away. ``done`` gives the answer, from the row, if an earlier try ended the attempt and
    only its acknowledgement was lost.
    """

    def decorate(write: _Write[P, T]) -> _Fenced[P, T]:
        @functools.wraps(write)
        async def fenced(self: Ledger, /, *given: P.args, **named: P.kwargs) -> T:
            async def once() -> T:
                async with self._database.transaction() as connection:
                    job = await connection.row(_LOCKED, self.claim.job_id)
                    if job is None or job["run_token"] != self.claim.token:
                        raise Fenced(f"job {self.claim.job_id} has a new owner")
                    if job["state"] != "running":
                        return done(job)
                    return await write(self, connection, job, *given, **named)

            return await retry_while_unavailable(once)

        return fenced

    return decorate


def _nothing(_: DictRow) -> None:
    return None


def _not_cancelled(job: DictRow) -> bool:
    return bool(job["state"] != "cancelled")


class Ledger:
    """The fenced writes of one attempt. Every method raises `Fenced`.

    Other attempts' files are deleted after twice ``stall_s``, when no process can still write them.
    """

    def __init__(self, database: Database, claim: Claim, stall_s: float) -> None:
        self.claim = claim
        self._database, self._stall_s = database, stall_s

    @_fenced(_nothing)
    async def progress(self, connection: Connection, job: DictRow, now: Progress) -> None:
        """Write the progress columns, and options if reported; a new stage is also an event."""
        resolved = None if now.options is None else Jsonb(now.options.model_dump(mode="json"))
        await connection.execute(
            "UPDATE jobs SET stage = %(stage)s, fraction = greatest(fraction, %(fraction)s), step = %(step)s,"
            " steps_total = %(steps_total)s, eta_s = %(eta_s)s, metrics = metrics || %(metrics)s,"
            " message = %(message)s, resolved_options = coalesce(%(options)s, resolved_options),"
            " revision = revision + 1, updated_at = clock_timestamp() WHERE id = %(id)s",
            {**dict(now), "metrics": Jsonb(now.metrics), "options": resolved, "id": job["id"]},
        )
        if now.stage != job["stage"]:
            await _add_event(connection, job, "stage", {"stage": now.stage})
        else:
            await connection.execute("SELECT pg_notify('biresnerf_jobs', %s)", (job["id"],))

    @_fenced(_nothing)
    async def note_use(self, connection: Connection, job: DictRow, processor_s: float) -> None:
        """Record that the attempt runs and what it has used; this counts if its end is never recorded."""
        await connection.execute(
            "UPDATE jobs SET attempt_seen_at = clock_timestamp(),"
            " attempt_processor_s = greatest(attempt_processor_s, %s) WHERE id = %s",
            (processor_s, job["id"]),
        )

    @_fenced(_nothing)
    async def checkpoint(
        self, connection: Connection, job: DictRow, prefix: str, files: Sequence[str], step: int
    ) -> None:
        """Point the job at a new checkpoint and discard the previous one."""
        if job["checkpoint"] is not None and job["checkpoint"]["prefix"] == prefix:
            return  # an earlier try was committed and only its acknowledgement lost
        await _discard_replaced(connection, job["checkpoint"], prefix)
        await _set(connection, job, "checkpoint", {"prefix": prefix, "files": list(files)})
        await connection.execute("UPDATE jobs SET crashes = 0, losses = 0 WHERE id = %s", (job["id"],))
        await _add_event(connection, job, "checkpoint", {"step": step})

    @_fenced(_nothing)
    async def reusable(
        self, connection: Connection, job: DictRow, stage: ReusableStage, prefix: str, files: Sequence[str]
    ) -> None:
        """Keep a stage's work for other jobs to reuse, in place of an earlier attempt's."""
        await _discard_replaced(connection, job["reusable"].get(stage), prefix)
        stages = {**job["reusable"], stage: {"prefix": prefix, "files": list(files)}}
        await _set(connection, job, "reusable", stages)

    @_fenced(_nothing)
    async def preview(
        self, connection: Connection, job: DictRow, prefix: str, artifacts: Sequence[Artifact], now: Progress
    ) -> None:
        """Let the job show these files in place of the previous ones."""
        if job["previews"] is not None and job["previews"]["prefix"] == prefix:
            return
        await _discard_replaced(connection, job["previews"], prefix, after_s=PREVIEW_KEPT_S)
        listed = [item.model_dump() for item in artifacts]
        await _set(connection, job, "previews", {"prefix": prefix, "artifacts": listed})
        data = {"stage": now.stage, "step": now.step, "files": [item.name for item in artifacts]}
        await _add_event(connection, job, "preview", data)

    async def log(self, lines: Sequence[str]) -> None:
        """Append lines to the job's log; lines beyond `LOG_LINES_MAX` are only in its log file."""
        await self._append(lines, [])

    @_fenced(_nothing)
    async def _append(
        self, connection: Connection, job: DictRow, lines: Sequence[str], lengths: list[int]
    ) -> None:
        """``lengths`` of the log before each try: if it grew, an earlier try was committed."""
        before = int(job["log_lines"])
        lengths.append(before)
        left = LOG_LINES_MAX - before
        kept = list(lines[: max(0, left)])
        if not kept or before != lengths[0]:
            return
        if len(kept) == left:
            kept[-1] = f"(the rest is in {LOG_NAME} alone)"
        await connection.execute(
            "INSERT INTO job_log (job_id, n, attempt, text)"
            " SELECT %s, %s + place, %s, text FROM unnest(%s::text[]) WITH ORDINALITY AS fresh (text, place)",
            (job["id"], before, self.claim.attempt, kept),
        )
        await connection.execute(
            "UPDATE jobs SET log_lines = log_lines + %s WHERE id = %s", (len(kept), job["id"])
        )

    @_fenced(lambda _: 0)
    async def crashes(self, _: Connection, job: DictRow) -> int:
        """How many attempts crashed since the job's last checkpoint, without this one."""
        return int(job["crashes"])

    @_fenced(lambda _: False)
    async def wants_partial(self, _: Connection, job: DictRow) -> bool:
        """Whether a partial result was requested with the cancellation."""
        return bool(job["keep_partial"])

    @_fenced(_not_cancelled)
    async def publish(
        self,
        connection: Connection,
        job: DictRow,
        artifacts: Sequence[Artifact],
        verdict: VerdictName | None,
        faults: Sequence[str] = (),
    ) -> bool:
        """Publish the job's result, and count faults by code.

        Returns False if a cancellation was requested first.
        """
        if job["cancel_requested"]:
            return False
        await connection.execute("UPDATE jobs SET verdict = %s WHERE id = %s", (verdict, job["id"]))
        for code in faults:
            await connection.execute("INSERT INTO tally_log (name, label) VALUES ('job_faults', %s)", (code,))
        await finish(connection, job["id"], "succeeded", None, artifacts)
        await trash_attempts(connection, job["id"], self._stall_s, self.claim.name)
        return True

    @_fenced(_not_cancelled)
    async def fail(
        self, connection: Connection, job: DictRow, error: JobError, artifacts: Sequence[Artifact]
    ) -> bool:
        """End the job as failed; returns False if a cancellation was requested first."""
        if job["cancel_requested"]:
            return False
        await finish(connection, job["id"], "failed", error, artifacts)
        await trash_attempts(connection, job["id"], self._stall_s, self.claim.name)
        return True

    @_fenced(_nothing)
    async def cancelled(
        self, connection: Connection, job: DictRow, artifacts: Sequence[Artifact], keep: str
    ) -> None:
        """End the job as cancelled, with these files, which are all that is in the folder ``keep`` of its results."""
        await finish_cancelled(connection, job["id"], self._stall_s, artifacts, keep)

    @_fenced(_not_cancelled)
    async def split(self, connection: Connection, job: DictRow, parts: Sequence[Mapping[str, Any]]) -> bool:
        """Queue a job with each of these options; this one waits for them. False if it was cancelled instead."""
        if job["cancel_requested"]:
            await finish_cancelled(connection, job["id"], self._stall_s)
            return False
        await split_job(connection, job["id"], parts)
        return True

    @_fenced(_not_cancelled)
    async def give_back(self, connection: Connection, job: DictRow, how: Requeue) -> bool:
        """Put the job back into the queue; returns False if it was cancelled instead."""
        if job["cancel_requested"]:
            await finish_cancelled(connection, job["id"], self._stall_s)
            return False
        await requeue(connection, job["id"], how)
        return True


async def _add_event(connection: Connection, job: DictRow, event: EventType, data: Mapping[str, Any]) -> None:
    """As `add_event`; beyond `EVENTS_MAX` events, only the job's record shows the change."""
    if job["seq"] < EVENTS_MAX:
        await add_event(connection, job["id"], event, data)
        return
    await connection.execute(
        "UPDATE jobs SET revision = revision + 1, updated_at = clock_timestamp() WHERE id = %s", (job["id"],)
    )
    await connection.execute("SELECT pg_notify('biresnerf_jobs', %s)", (job["id"],))


async def _set(
    connection: Connection,
    job: DictRow,
    column: Literal["checkpoint", "reusable", "previews"],
    value: Mapping[str, Any],
) -> None:
    update = sql.SQL("UPDATE jobs SET {} = %s WHERE id = %s").format(sql.Identifier(column))
    await connection.execute(update, (Jsonb(value), job["id"]))


async def _discard_replaced(
    connection: Connection, replaced: Mapping[str, Any] | None, prefix: str, *, after_s: float = 0.0
) -> None:
    """Discard the files that a column referred to before those under ``prefix``."""
    if replaced is not None and replaced["prefix"] != prefix:
        await discard(connection, replaced["prefix"], after_s=after_s)
