"""What a running attempt writes into its job, each write fenced by the attempt's token.

Of two processes that believe they run a job (one was frozen and taken for dead), only the one that claimed
last can write. The other gets `Fenced` and must leave without touching the queue.
"""

from __future__ import annotations

from collections.abc import Awaitable, Callable, Mapping, Sequence
from typing import Any, Literal, TypeVar

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
from workers.jobs.job_states import add_event, finish, finish_cancelled, requeue, trash_attempts
from workers.process.waiting import retry_while_unavailable
from workers.records import LOG_NAME, Artifact
from workers.store.trash import discard

PREVIEW_KEPT_S = 60.0  # after another one took its place: it may be on its way to somebody
LOG_LINES_MAX = 20_000  # of one job
_LOCKED = """
    SELECT run_token, state, cancel_requested, keep_partial, log_lines, checkpoint, reusable, previews
    FROM jobs WHERE id = %s FOR UPDATE"""
T = TypeVar("T")


class Ledger:
    """The fenced writes of one attempt. While the database is away each waits for it, without end."""

    def __init__(self, database: Database, claim: Claim) -> None:
        self.claim = claim
        self._database = database
        self._stage: str | None = None

    async def progress(self, now: Progress) -> None:
        """Write the progress columns, and the options where they are reported; a new stage is also an event."""
        resolved = None if now.options is None else Jsonb(now.options.model_dump(mode="json"))

        async def write(connection: Connection, job: DictRow) -> None:
            await connection.execute(
                "UPDATE jobs SET stage = %s, fraction = greatest(fraction, %s), step = %s, steps_total = %s,"
                " eta_s = %s, metrics = metrics || %s, message = %s,"
                " resolved_options = coalesce(%s, resolved_options), revision = revision + 1,"
                " updated_at = clock_timestamp() WHERE id = %s",
                (
                    *(now.stage, now.fraction, now.step, now.steps_total, now.eta_s),
                    *(Jsonb(now.metrics), now.message, resolved, self.claim.job_id),
                ),
            )
            if now.stage != self._stage:
                await add_event(connection, self.claim.job_id, "stage", {"stage": now.stage})
            else:
                await connection.execute("SELECT pg_notify('biresnerf_jobs', %s)", (self.claim.job_id,))

        await self._fenced(write)
        self._stage = now.stage

    async def checkpoint(self, prefix: str, files: Sequence[str], step: int) -> None:
        """Point the job at a new checkpoint and give the one before to the trash."""

        async def write(connection: Connection, job: DictRow) -> None:
            await _discard_replaced(connection, job["checkpoint"], prefix)
            await self._set(connection, "checkpoint", {"prefix": prefix, "files": list(files)})
            await add_event(connection, self.claim.job_id, "checkpoint", {"step": step})

        await self._fenced(write)

    async def reusable(self, stage: ReusableStage, prefix: str, files: Sequence[str]) -> None:
        """Keep the work of a stage for other jobs to start from, in the place of an earlier attempt's."""

        async def write(connection: Connection, job: DictRow) -> None:
            await _discard_replaced(connection, job["reusable"].get(stage), prefix)
            stages = {**job["reusable"], stage: {"prefix": prefix, "files": list(files)}}
            await self._set(connection, "reusable", stages)

        await self._fenced(write)

    async def preview(self, prefix: str, artifacts: Sequence[Artifact], now: Progress) -> None:
        """Let the job show these files, in the place of those before."""

        async def write(connection: Connection, job: DictRow) -> None:
            await _discard_replaced(connection, job["previews"], prefix, after_s=PREVIEW_KEPT_S)
            listed = [item.model_dump() for item in artifacts]
            await self._set(connection, "previews", {"prefix": prefix, "artifacts": listed})
            data = {"stage": now.stage, "step": now.step, "files": [item.name for item in artifacts]}
            await add_event(connection, self.claim.job_id, "preview", data)

        await self._fenced(write)

    async def log(self, lines: Sequence[str]) -> None:
        """Append lines to the job's log; what is more than `LOG_LINES_MAX` is in its log file alone."""
        before: int | None = None

        async def write(connection: Connection, job: DictRow) -> None:
            nonlocal before
            if before is not None and job["log_lines"] != before:
                return  # an earlier try got through, though its acknowledgement was lost
            before = int(job["log_lines"])
            room = LOG_LINES_MAX - before
            kept = list(lines[: max(0, room)])
            if kept and len(kept) == room:
                kept[-1] = f"(the rest is in {LOG_NAME} alone)"
            if not kept:
                return
            await connection.execute(
                "INSERT INTO job_log (job_id, n, attempt, text)"
                " SELECT %s, %s + place, %s, text FROM unnest(%s::text[]) WITH ORDINALITY AS fresh (text, place)",
                (self.claim.job_id, before, self.claim.attempt, kept),
            )
            await connection.execute(
                "UPDATE jobs SET log_lines = log_lines + %s WHERE id = %s", (len(kept), self.claim.job_id)
            )

        await self._fenced(write)

    async def wants_partial(self) -> bool:
        """Whether who cancelled the job wants what there is of its result."""

        async def read(_: Connection, job: DictRow) -> bool:
            return bool(job["keep_partial"])

        return await self._fenced(read, done=False)

    async def publish(
        self, artifacts: Sequence[Artifact], verdict: VerdictName | None, keep: str, stall_s: float
    ) -> bool:
        """Make the result the job's one result; False where a cancellation was asked for first.

        Files of other attempts are deleted once no process can still be writing them.
        """

        async def write(connection: Connection, job: DictRow) -> bool:
            if job["cancel_requested"]:
                return False
            await connection.execute(
                "UPDATE jobs SET verdict = %s WHERE id = %s", (verdict, self.claim.job_id)
            )
            await finish(connection, self.claim.job_id, "succeeded", None, artifacts)
            await trash_attempts(connection, self.claim.job_id, keep, stall_s)
            return True

        return await self._fenced(write, done=True)

    async def fail(self, error: JobError, artifacts: Sequence[Artifact], keep: str, stall_s: float) -> None:
        """End the job as failed (or cancelled, if that was asked for)."""

        async def write(connection: Connection, job: DictRow) -> None:
            if job["cancel_requested"]:
                await finish_cancelled(connection, self.claim.job_id, artifacts, keep, stall_s)
                return
            await finish(connection, self.claim.job_id, "failed", error, artifacts)
            await trash_attempts(connection, self.claim.job_id, keep, stall_s)

        await self._fenced(write, done=None)

    async def cancelled(self, artifacts: Sequence[Artifact], keep: str, stall_s: float) -> None:
        """End the job as cancelled, with what is wanted of the files."""

        async def write(connection: Connection, job: DictRow) -> None:
            await finish_cancelled(connection, self.claim.job_id, artifacts, keep, stall_s)

        await self._fenced(write, done=None)

    async def give_back(
        self,
        event: EventType,
        data: dict[str, Any],
        *,
        counted: bool,
        forget_checkpoint: bool = False,
        smaller: dict[str, Any] | None = None,
    ) -> bool:
        """Back to the queue, the attempt counted or not; False if the job was cancelled instead.

        ``smaller``: options that attempts to come use in the place of those asked for.
        """

        async def write(connection: Connection, job: DictRow) -> bool:
            if job["cancel_requested"]:
                await finish_cancelled(connection, self.claim.job_id)
                return False
            await requeue(
                connection,
                self.claim.job_id,
                event,
                data,
                uncounted=not counted,
                forget_checkpoint=forget_checkpoint,
                smaller=smaller,
            )
            return True

        return await self._fenced(write, done=True)

    async def _set(
        self,
        connection: Connection,
        column: Literal["checkpoint", "reusable", "previews"],
        value: dict[str, Any],
    ) -> None:
        update = sql.SQL("UPDATE jobs SET {} = %s WHERE id = %s").format(sql.Identifier(column))
        await connection.execute(update, (Jsonb(value), self.claim.job_id))

    async def _fenced(
        self, write: Callable[[Connection, DictRow], Awaitable[T]], *, done: T | None = None
    ) -> T:
        """Run ``write`` under the job's row lock, with the row, if the token still holds.

        ``done`` is the answer where an earlier try got through, though its acknowledgement was lost.
        """

        async def once() -> T:
            async with self._database.transaction() as connection:
                job = await connection.row(_LOCKED, self.claim.job_id)
                if job is None or job["run_token"] != self.claim.token:
                    raise Fenced(f"job {self.claim.job_id} has a new owner")
                if job["state"] != "running":
                    return done  # type: ignore[return-value]
                return await write(connection, job)

        return await retry_while_unavailable(once)


async def _discard_replaced(
    connection: Connection, replaced: Mapping[str, Any] | None, prefix: str, *, after_s: float = 0.0
) -> None:
    """Have the files deleted that a column named before those under ``prefix``."""
    if replaced is not None and replaced["prefix"] != prefix:
        await discard(connection, replaced["prefix"], after_s=after_s)
