"""What a running attempt writes into its job, each write fenced by the attempt's token.

Of two processes that believe they run a job (one was frozen and taken for dead), only the one that claimed
last can write. The other gets `Fenced` and must leave without touching the queue.
"""

from __future__ import annotations

import asyncio
import logging
import uuid
from collections.abc import Awaitable, Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal, TypeVar

from psycopg.types.json import Jsonb

from biresnerf.progress import Progress
from biresnerf.report import VerdictName
from workers.database import Connection, Database
from workers.errors import Unavailable
from workers.records import Artifact, EventType, JobError

log = logging.getLogger(__name__)

RETRY_S = 0.5
End = Literal["succeeded", "failed", "cancelled", "queued"]
T = TypeVar("T")


class Fenced(BaseException):
    """Somebody else has claimed the job since. Not an `Exception`: nothing may swallow it."""


@dataclass(frozen=True)
class Claim:
    """One attempt of one job, owned by whoever holds ``token``."""

    job_id: str
    dataset_id: str
    attempt: int
    token: uuid.UUID
    options: dict[str, Any]
    checkpoint: dict[str, Any] | None

    @property
    def name(self) -> str:
        """Folder name of this attempt, never used by another one."""
        return f"{self.attempt}-{self.token.hex[:8]}"


async def claim_job(database: Database, job_id: str, max_attempts: int) -> Claim | None:
    """Take a job over with a fresh token; none where there is nothing to run.

    A job whose cancellation was asked for ends ``cancelled``, one that had its attempts ends ``failed``.
    """
    token = uuid.uuid4()
    return await insist(lambda: _claim(database, job_id, max_attempts, token))


async def _claim(database: Database, job_id: str, max_attempts: int, token: uuid.UUID) -> Claim | None:
    async with database.transaction() as connection:
        cursor = await connection.execute(
            "SELECT state, attempt, cancel_requested, run_token, dataset_id, options, checkpoint"
            " FROM jobs WHERE id = %s FOR UPDATE",
            (job_id,),
        )
        row = await cursor.fetchone()
        if row is not None and row["run_token"] == token:
            # An earlier try got through, though its acknowledgement was lost: the attempt counts once.
            same = {key: row[key] for key in ("dataset_id", "attempt", "options", "checkpoint")}
            return Claim(job_id, token=token, **same)
        if row is None or row["state"] not in ("queued", "running"):
            return None
        if row["cancel_requested"]:
            await _finish(connection, job_id, "cancelled", None)
            return None
        if row["attempt"] >= max_attempts:
            await _finish(connection, job_id, "failed", crashed_too_often(row["attempt"]))
            return None
        cursor = await connection.execute(
            "UPDATE jobs SET state = 'running', attempt = attempt + 1, run_token = %s, fraction = 0,"
            " step = 0, stage = NULL, eta_s = NULL, message = '',"
            " started_at = coalesce(started_at, clock_timestamp())"
            " WHERE id = %s RETURNING dataset_id, attempt, options, checkpoint",
            (token, job_id),
        )
        claimed = await cursor.fetchone()
        assert claimed is not None, "the row is locked"
        resumed = Jsonb({"resumed": claimed["checkpoint"] is not None})
        await connection.execute("SELECT add_job_event(%s, 'started', %s)", (job_id, resumed))
        return Claim(job_id, token=token, **claimed)


class Ledger:
    """The fenced writes of one attempt. While the database is away each waits for it, without end."""

    def __init__(self, database: Database, claim: Claim) -> None:
        self.claim = claim
        self._database = database
        self._stage: str | None = None

    async def progress(self, now: Progress) -> None:
        """Write the progress columns; a new stage is also an event."""

        async def write(connection: Connection) -> None:
            await connection.execute(
                "UPDATE jobs SET stage = %s, fraction = greatest(fraction, %s), step = %s, steps_total = %s,"
                " eta_s = %s, metrics = metrics || %s, message = %s, revision = revision + 1,"
                " updated_at = clock_timestamp() WHERE id = %s",
                (
                    *(now.stage, now.fraction, now.step, now.steps_total, now.eta_s),
                    *(Jsonb(now.metrics), now.message, self.claim.job_id),
                ),
            )
            if now.stage != self._stage:
                await _add_event(connection, self.claim.job_id, "stage", {"stage": now.stage})
            else:
                await connection.execute("SELECT pg_notify('biresnerf_jobs', %s)", (self.claim.job_id,))

        await self._fenced(write)
        self._stage = now.stage

    async def checkpoint(self, prefix: str, files: Sequence[str], step: int) -> None:
        """Point the job at a new checkpoint and give the one before to the trash."""

        async def write(connection: Connection) -> None:
            await connection.execute(
                "INSERT INTO trash (prefix) SELECT checkpoint ->> 'prefix' FROM jobs"
                " WHERE id = %s AND checkpoint ->> 'prefix' <> %s",
                (self.claim.job_id, prefix),
            )
            await connection.execute(
                "UPDATE jobs SET checkpoint = %s WHERE id = %s",
                (Jsonb({"prefix": prefix, "files": list(files)}), self.claim.job_id),
            )
            await _add_event(connection, self.claim.job_id, "checkpoint", {"step": step})

        await self._fenced(write)

    async def publish(
        self, artifacts: Sequence[Artifact], verdict: VerdictName | None, keep: str, stall_s: float
    ) -> bool:
        """Make the result the job's one result; False where a cancellation was asked for first.

        What other attempts left is deleted once nobody can be writing it any more.
        """

        async def write(connection: Connection) -> bool:
            if await _cancel_requested(connection, self.claim.job_id):
                return False
            await connection.execute(
                "UPDATE jobs SET verdict = %s WHERE id = %s", (verdict, self.claim.job_id)
            )
            await _finish(connection, self.claim.job_id, "succeeded", None, artifacts)
            await _trash_attempts(connection, self.claim.job_id, keep, stall_s)
            return True

        return await self._fenced(write, done=True)

    async def fail(self, error: JobError, artifacts: Sequence[Artifact], keep: str, stall_s: float) -> None:
        """End the job as failed (or cancelled, if that was asked for)."""

        async def write(connection: Connection) -> None:
            if await _cancel_requested(connection, self.claim.job_id):
                await _finish(connection, self.claim.job_id, "cancelled", None, artifacts)
            else:
                await _finish(connection, self.claim.job_id, "failed", error, artifacts)
            await _trash_attempts(connection, self.claim.job_id, keep, stall_s)

        await self._fenced(write, done=None)

    async def cancelled(self, artifacts: Sequence[Artifact], keep: str, stall_s: float) -> None:
        """End the job as cancelled."""

        async def write(connection: Connection) -> None:
            await _finish(connection, self.claim.job_id, "cancelled", None, artifacts)
            await _trash_attempts(connection, self.claim.job_id, keep, stall_s)

        await self._fenced(write, done=None)

    async def give_back(
        self, event: EventType, data: dict[str, Any], *, counted: bool, forget_checkpoint: bool = False
    ) -> bool:
        """Back to the queue, the attempt counted or not; False if the job was cancelled instead."""

        async def write(connection: Connection) -> bool:
            if await _cancel_requested(connection, self.claim.job_id):
                await _finish(connection, self.claim.job_id, "cancelled", None)
                return False
            await connection.execute(
                "UPDATE jobs SET state = 'queued', attempt = attempt - %s, eta_s = NULL,"
                " checkpoint = CASE WHEN %s THEN NULL ELSE checkpoint END WHERE id = %s",
                (0 if counted else 1, forget_checkpoint, self.claim.job_id),
            )
            await _add_event(connection, self.claim.job_id, event, data)
            return True

        return await self._fenced(write, done=True)

    async def _fenced(self, write: Callable[[Connection], Awaitable[T]], *, done: T | None = None) -> T:
        """Run ``write`` under the job's row lock if the token still holds.

        ``done`` is the answer where an earlier try got through, though its acknowledgement was lost.
        """

        async def once() -> T:
            async with self._database.transaction() as connection:
                cursor = await connection.execute(
                    "SELECT run_token, state FROM jobs WHERE id = %s FOR UPDATE", (self.claim.job_id,)
                )
                row = await cursor.fetchone()
                if row is None or row["run_token"] != self.claim.token:
                    raise Fenced(f"job {self.claim.job_id} has a new owner")
                if row["state"] != "running":
                    return done  # type: ignore[return-value]
                return await write(connection)

        return await insist(once)


def crashed_too_often(attempts: int, log_tail: str = "") -> JobError:
    """The error of a job whose every attempt died."""
    return JobError(
        code="too_many_crashes",
        detail=f"The job's process died in each of {attempts} attempts.",
        mend="Try smaller options (preset fast, a smaller max_image_size) or a machine with more memory.",
        log_tail=log_tail,
    )


async def insist(write: Callable[[], Awaitable[T]]) -> T:
    """The answer of ``write``, tried again for as long as the database is away."""
    while True:
        try:
            return await write()
        except Unavailable as error:
            log.warning("%s; trying again", error)
            await asyncio.sleep(RETRY_S)


async def _finish(
    connection: Connection,
    job_id: str,
    state: End,
    error: JobError | None,
    artifacts: Sequence[Artifact] = (),
) -> None:
    await connection.execute(
        "UPDATE jobs SET state = %s, error = %s, artifacts = %s, finished_at = clock_timestamp(),"
        " eta_s = NULL, fraction = CASE WHEN %s = 'succeeded' THEN 1 ELSE fraction END WHERE id = %s",
        (
            *(state, Jsonb(error.model_dump()) if error else None),
            *(Jsonb([item.model_dump() for item in artifacts]), state, job_id),
        ),
    )
    data = {"code": error.code, "detail": error.detail} if error else {}
    await _add_event(connection, job_id, state, data)


async def _add_event(connection: Connection, job_id: str, event: str, data: dict[str, Any]) -> None:
    await connection.execute("SELECT add_job_event(%s, %s, %s)", (job_id, event, Jsonb(data)))


async def _cancel_requested(connection: Connection, job_id: str) -> bool:
    cursor = await connection.execute("SELECT cancel_requested FROM jobs WHERE id = %s", (job_id,))
    row = await cursor.fetchone()
    return bool(row and row["cancel_requested"])


async def _trash_attempts(connection: Connection, job_id: str, keep: str, stall_s: float) -> None:
    # Twice the stall time: a frozen owner that wakes up later finds itself fenced at its first write.
    await connection.execute(
        "INSERT INTO trash (prefix, keep, not_before)"
        " SELECT prefix, keep, clock_timestamp() + make_interval(secs => %s)"
        " FROM (VALUES (%s, NULL), (%s, %s)) AS garbage (prefix, keep)",
        (2 * stall_s, f"jobs/{job_id}/checkpoints", f"jobs/{job_id}/results", keep),
    )
