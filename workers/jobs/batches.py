"""Batches: jobs that are submitted together, with one status. Triggers of the schema write the end of a batch."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from biresnerf.errors import FaultError
from biresnerf.wire.batches import BatchJob, BatchView, NewBatch
from workers.database.database import Connection
from workers.database.ids import new_id
from workers.jobs.job_rows import asked_columns, fingerprint_of, submission_fingerprint
from workers.jobs.jobs import JobStore
from workers.jobs.quotas import submitting_for
from workers.records import record_from_row
from workers.settings.errors import Conflict
from workers.settings.traces import TRACER
from workers.tenants.tenants import LOCAL_TENANT
from workers.webhooks.webhooks import add_webhook


class Batches(JobStore):
    """The job store, extended by batches."""

    def __init__(self, jobs: JobStore) -> None:
        super().__init__(jobs._database, jobs._listener, jobs._settings)
        self._tenant, self._key_id = jobs._tenant, jobs._key_id

    @TRACER.start_as_current_span("submit batch")
    async def submit_batch(
        self, asked: NewBatch, *, idempotency_key: str | None = None
    ) -> tuple[BatchView, bool]:
        """Queue all of the jobs in one transaction, or none of them.

        Returns the batch and whether it is new (False: the same key with the same request came before).
        Raises what `submit` does, with the job at fault in ``where``.
        """
        tenant = self._tenant or LOCAL_TENANT
        columns = []
        for place, job in enumerate(asked.jobs):
            with _at(place):
                columns.append({"tenant": tenant, **asked_columns(job.options)})
        prints = [submission_fingerprint(job.dataset_id, job) for job in asked.jobs]
        told = asked.webhook.model_dump(mode="json") if asked.webhook else {}
        fingerprint = fingerprint_of(" ".join(prints), told)
        async with self._database.transaction() as connection:
            await submitting_for(connection, {job.dataset_id for job in asked.jobs}, tenant)
            if idempotency_key is not None:
                sql = "SELECT id, fingerprint FROM batches WHERE tenant = %s AND idempotency_key = %s"
                known = await connection.row(sql, tenant, idempotency_key)
                if known is not None and known["fingerprint"] != fingerprint:
                    raise Conflict(
                        "idempotency_key_reused", f"The key was used for another request ({known['id']})."
                    )
                if known is not None:
                    return await self._view(connection, known["id"]), False
            batch_id = new_id("bat")
            await connection.execute(
                "INSERT INTO batches (id, tenant, idempotency_key, fingerprint) VALUES (%s, %s, %s, %s)",
                (batch_id, tenant, idempotency_key, fingerprint),
            )
            if asked.webhook is not None:
                settings, hook = self._settings, asked.webhook
                await add_webhook(connection, settings, tenant, hook, ["batch.finished"], batch_id=batch_id)
            for place, job in enumerate(asked.jobs):
                with _at(place):
                    more = {"batch_id": batch_id, "fingerprint": prints[place]}
                    await self._add(connection, job, {**columns[place], **more})
            return await self._view(connection, batch_id), True

    async def batch(self, batch_id: str) -> BatchView:
        """The batch now; raises `NotFound`."""
        async with self._database.transaction() as connection:
            await connection.execute("SET TRANSACTION ISOLATION LEVEL REPEATABLE READ")
            return await self._view(connection, batch_id)

    async def cancel_batch(self, batch_id: str, *, keep_partial: bool = False) -> BatchView:
        """Cancel each of its jobs, as `cancel` does; raises `NotFound`."""
        # One by one: a single transaction would hold each row while it waits for the next.
        for job in (await self.batch(batch_id)).jobs:
            await self.cancel(job.id, keep_partial=keep_partial)
        return await self.batch(batch_id)

    async def _view(self, connection: Connection, batch_id: str) -> BatchView:
        sql = "SELECT * FROM batches WHERE id = %s AND tenant = coalesce(%s, tenant)"
        row = await connection.required_row(f"No batch {batch_id}.", sql, batch_id, self._tenant)
        jobs = await connection.rows(
            "SELECT * FROM jobs WHERE batch_id = %s ORDER BY created_at, id", batch_id
        )
        shown = tuple(record_from_row(BatchJob, job) for job in jobs)
        counts: dict[Any, int] = dict(Counter(job.state for job in shown))
        return record_from_row(BatchView, row, jobs=shown, counts=counts)


@contextmanager
def _at(place: int) -> Iterator[None]:
    """Adds to an error which job of the request it is about."""
    try:
        yield
    except FaultError as error:
        error.where = "/".join(filter(None, (f"jobs/{place}", error.where)))
        error.fault = error.fault.model_copy(update={"where": error.where})
        raise
