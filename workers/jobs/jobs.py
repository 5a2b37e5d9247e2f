"""Job records: submit, read, cancel, delete, follow. For the service; never loads torch."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncGenerator, Mapping
from datetime import datetime
from typing import Any, Self, Unpack

from psycopg.types.json import Jsonb

from biresnerf.options.refine_options import RefineOptions
from biresnerf.wire.base import Page
from biresnerf.wire.deliveries import DeliverTo
from biresnerf.wire.jobs import JobDetails, JobState, JobTexts, JobView, LogLine, NewJob
from workers.database.database import Connection, Database, OwnedStore
from workers.database.ids import new_id
from workers.jobs.deadlines import limit_columns
from workers.jobs.deliveries import add_deliveries, lock_for_delivery
from workers.jobs.job_rows import (
    JOB,
    MINE,
    PARTS,
    PLACES,
    asked_columns,
    events_of,
    job_from_row,
    known_job,
    require_files,
    require_result,
    submission_fingerprint,
)
from workers.jobs.job_states import cancel_part_of_ended, delete_job, insert_job, queue_job, request_cancel
from workers.jobs.job_updates import JobListener, follow
from workers.jobs.quotas import require_room, submitting_for
from workers.records import (
    LOG_NAME,
    NEWEST_FIRST,
    PRIORITIES,
    Artifact,
    JobUpdate,
    newest_first,
    page_of,
)
from workers.settings.errors import Conflict
from workers.settings.settings import Settings
from workers.settings.traces import TRACER
from workers.tenants.tenants import LOCAL_TENANT
from workers.webhooks.webhooks import add_webhook


class JobStore(OwnedStore):
    """Jobs in the database. Get one from `workers.engine.open_stores`.

    Every method raises `Unavailable` (``database_unavailable``) if the database does not answer.
    """

    def __init__(self, database: Database, listener: JobListener, settings: Settings) -> None:
        super().__init__(database)
        self._listener, self._settings = listener, settings
        self._key_id: str | None = None

    def for_tenant(self, tenant: str | None, key_id: str | None = None) -> Self:
        """The store limited to the tenant; records this key on new jobs."""
        bound = super().for_tenant(tenant)
        bound._key_id = key_id
        return bound

    @TRACER.start_as_current_span("submit")
    async def submit(
        self,
        dataset_id: str,
        options: RefineOptions,
        *,
        labels: Mapping[str, str] | None = None,
        idempotency_key: str | None = None,
        request_digest: str | None = None,
        **details: Unpack[JobDetails],
    ) -> tuple[JobView, bool]:
        """Queue a job at its tenant's turn; the job and its queue entry are written in one transaction.

        ``request_digest`` replaces the dataset when requests are compared, if the client sent the files with the
        request (see `repeated`). Returns the job and whether it is new (False: the same key with the same request came
        before). Raises `NotFound` (dataset, job), `Conflict` (``dataset_not_ready``, ``idempotency_key_reused``,
        ``priority_not_allowed``, a code of `require_result`), `LimitReached` (``queue_full``, ``quota_exhausted``,
        ``daily_limit_reached``), `InputError` (``invalid_options``, ``webhook_url_refused``, ``address_refused``,
        ``deadline_refused``).
        """
        asked = NewJob(dataset_id=dataset_id, options=options, labels=dict(labels or {}), **details)
        columns = asked_columns(options)
        fingerprint = submission_fingerprint(request_digest or dataset_id, asked)
        async with self._database.transaction() as connection:
            tenant = await submitting_for(connection, {dataset_id}, self._tenant)
            if idempotency_key is not None:
                known = await known_job(connection, tenant, idempotency_key, fingerprint)
                if known is not None:
                    return known, False
            columns |= {"tenant": tenant, "idempotency_key": idempotency_key, "fingerprint": fingerprint}
            job_id = await self._add(connection, asked, columns)
            return job_from_row(await self._required(connection, job_id)), True

    async def _add(self, connection: Connection, asked: NewJob, columns: Mapping[str, Any]) -> str:
        """Insert and queue a job with these further columns; returns its id. See `submit`."""
        if asked.fixed_from is not None:
            require_result(await self._required(connection, asked.fixed_from))
        priority = PRIORITIES[asked.priority]
        await require_room(connection, asked.dataset_id, priority, self._settings.max_queued)
        job_id = new_id("job")
        added = await insert_job(
            connection,
            {
                "id": job_id,
                "dataset_id": asked.dataset_id,
                "priority": priority,
                "fixed_from": asked.fixed_from,
                "part_photos": asked.part_photos,
                "key_id": self._key_id,
                "labels": Jsonb(asked.labels),
                **await limit_columns(connection, asked),
                **columns,
            },
        )
        if (hook := asked.webhook) is not None:
            await add_webhook(connection, self._settings, columns["tenant"], hook, hook.events, job_id=job_id)
        if asked.deliver is not None:
            await add_deliveries(connection, self._settings, job_id, asked.deliver)
        await queue_job(connection, added)  # the webhook gets this event
        return job_id

    async def repeated(
        self,
        request_digest: str,
        asked: JobTexts,
        idempotency_key: str,
    ) -> JobView | None:
        """The job of an earlier request with this key, to check before any other work.

        Raises `Conflict` (``idempotency_key_reused``) if the earlier request was a different one.
        """
        fingerprint = submission_fingerprint(request_digest, asked)
        async with self._database.transaction() as connection:
            return await known_job(connection, self._tenant or LOCAL_TENANT, idempotency_key, fingerprint)

    async def get(self, job_id: str) -> JobView:
        """The job now; raises `NotFound`."""
        async with self._database.transaction() as connection:
            return job_from_row(await self._required(connection, job_id))

    async def list(
        self,
        *,
        state: JobState | None = None,
        label: tuple[str, str] | None = None,
        created_after: datetime | None = None,
        limit: int = 50,
        cursor: str | None = None,
    ) -> Page[JobView]:
        """Refinements but those that are parts of others, newest first; raises `InputError` (``bad_cursor``)."""
        rows = await self._database.fetch(
            f"WITH page AS MATERIALIZED (SELECT *, {PARTS} FROM jobs"
            f" WHERE kind = 'refine' AND parent IS NULL AND {MINE}"
            " AND (%s::timestamptz IS NULL OR created_at > %s)"
            " AND (%s::text IS NULL OR state = %s) AND (%s::jsonb IS NULL OR labels @> %s)"
            f"{NEWEST_FIRST}), {PLACES}"
            " SELECT page.*, places.queue_position FROM page"
            " LEFT JOIN places ON page.state = 'queued' AND places.queue_id = page.queue_id"
            " ORDER BY page.created_at DESC, page.id DESC",
            *(self._tenant, created_after, created_after, state, state),
            *((Jsonb({label[0]: label[1]}),) * 2 if label else (None, None)),
            *newest_first(cursor, limit),
        )
        return page_of(map(job_from_row, rows), limit)

    async def deliver(self, job_id: str, to: DeliverTo) -> JobView:
        """Send files of the job, now or once it has ended; a new address replaces the old one.

        Raises `NotFound`, `Expired`, `Conflict` (``state_conflict``: an export), `InputError` (``address_refused``).
        """
        async with self._database.transaction() as connection:
            await lock_for_delivery(connection, job_id)
            row = await self._required(connection, job_id)
            if row["kind"] != "refine":
                raise Conflict("state_conflict", f"{job_id} is an export; its files are those of its parent.")
            require_files(row)
            await add_deliveries(connection, self._settings, job_id, to)
            return job_from_row(await self._required(connection, job_id))

    async def cancel(self, job_id: str, *, keep_partial: bool = False) -> JobView:
        """Cancel a job: a queued one at once, a running one within seconds.

        With ``keep_partial`` the best poses so far are published, with a report that marks them as partial. The first
        request decides. A final job is returned unchanged. Raises `NotFound`.
        """
        async with self._database.transaction() as connection:
            await request_cancel(connection, job_id, self._tenant, keep_partial, self._settings.stall_s)
            cancelled = job_from_row(await self._required(connection, job_id))
        if cancelled.parts is not None:
            while await self._database.run(cancel_part_of_ended, self._settings.stall_s):
                pass
        return cancelled

    async def delete(self, job_id: str) -> None:
        """Delete a final job with its files; raises `NotFound`, `Conflict` (``state_conflict``)."""
        async with self._database.transaction() as connection:
            sql = f"SELECT state FROM jobs WHERE id = %s AND {MINE} FOR UPDATE"
            row = await connection.required_row(f"No job {job_id}.", sql, job_id, self._tenant)
            if row["state"] in ("queued", "running"):
                raise Conflict("state_conflict", f"Job {job_id} is {row['state']}; cancel it first.")
            busy = await connection.row(
                "SELECT id FROM jobs WHERE state IN ('queued', 'running') AND (parent = %s OR fixed_from = %s"
                " OR id = (SELECT parent FROM jobs WHERE id = %s AND kind = 'refine'))",
                *(job_id, job_id, job_id),
            )
            if busy is not None:
                raise Conflict(
                    "state_conflict", f"{busy['id']}, which needs it, is not over; cancel that first."
                )
            await delete_job(connection, job_id)

    async def artifacts(self, job_id: str) -> tuple[Artifact, ...]:
        """The published files, by name, with those of its exports; while the job runs its previews.

        Raises `NotFound`, `Expired`.
        """
        async with self._database.transaction() as connection:
            own = await self._required(connection, job_id)
            require_files(own)
            exports = await connection.rows(
                "SELECT artifacts FROM jobs WHERE parent = %s AND kind = 'export' AND state = 'succeeded'",
                job_id,
            )
        listed = [*own["artifacts"], *(own["previews"] or {}).get("artifacts", [])]
        listed += [item for row in exports for item in row["artifacts"] if item["name"] != LOG_NAME]
        # A format of the result may have been exported as well; the files are the same.
        named = {item["name"]: item for item in reversed(listed)}
        return tuple(Artifact.model_validate(named[name]) for name in sorted(named))

    async def log(self, job_id: str, *, after: int = 0, limit: int = 1000) -> tuple[LogLine, ...]:
        """What the job's process wrote to standard error, after line ``after``; raises `NotFound`."""
        async with self._database.transaction() as connection:
            await self._required(connection, job_id)
            select = "SELECT n, at, attempt, text FROM job_log WHERE job_id = %s AND n > %s"
            rows = await connection.rows(f"{select} ORDER BY n LIMIT %s", job_id, after, limit)
            return tuple(map(LogLine.model_validate, rows))

    async def update(self, job_id: str, after: int = 0) -> JobUpdate:
        """The job and the events after ``after``, read in one snapshot; raises `NotFound`."""
        async with self._database.transaction() as connection:
            await connection.execute("SET TRANSACTION ISOLATION LEVEL REPEATABLE READ")
            job = job_from_row(await self._required(connection, job_id))
            return JobUpdate(job=job, events=await events_of(connection, job_id, after))

    def subscribe(
        self, job_id: str, *, after: int = 0, heartbeat_s: float = 15.0
    ) -> AsyncGenerator[JobUpdate | None]:
        """Follow a job: first its state and the events after ``after``, then every change.

        Yields None when nothing changed for ``heartbeat_s`` (time for a keep-alive). Ends after the update
        that carries a final state. Progress is in ``update.job``, at most once a second. Survives a restart
        of the database. Raises `NotFound`, also when the job is deleted meanwhile.
        """
        return follow(self.update, self._listener, self._tenant, job_id, after, heartbeat_s)

    async def wait(self, job_id: str, *, timeout_s: float) -> JobView:
        """The job as soon as it is final, or else after ``timeout_s`` (for long polls)."""
        job = await self.get(job_id)
        updates = follow(self.update, self._listener, self._tenant, job_id, 0, timeout_s)
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(timeout_s), contextlib.aclosing(updates):
                async for update in updates:
                    job = job if update is None else update.job
        return job

    async def counts(self) -> dict[JobState, int]:
        """How many jobs are in each state."""
        rows = await self._database.fetch(
            f"SELECT state, count(*) AS n FROM jobs WHERE {MINE} GROUP BY state", self._tenant
        )
        return {row["state"]: row["n"] for row in rows}

    async def _required(self, connection: Connection, job_id: str) -> dict[str, Any]:
        sql = JOB + f" WHERE id = %s AND {MINE}"
        return await connection.required_row(f"No job {job_id}.", sql, job_id, self._tenant)
