"""Files of jobs to be sent to their owners' addresses: requests and outcomes."""

from __future__ import annotations

from datetime import UTC, datetime

from psycopg.types.json import Jsonb

from biresnerf.errors import InputError
from biresnerf.wire.deliveries import DeliveredFile, DeliverTo
from biresnerf.wire.problems import JobError
from workers.database.database import Connection
from workers.database.ids import new_id
from workers.settings.settings import Settings
from workers.webhooks.outbound import Policy, checked_url

# Selects the rows `work` of job_deliveries whose jobs have ended.
DUE = "JOIN jobs ON jobs.id = work.job_id WHERE jobs.state NOT IN ('queued', 'running')"


async def lock_for_delivery(connection: Connection, job_id: str) -> None:
    """Lock the job before its deliveries, the order in which a deletion locks them."""
    await connection.execute("SELECT 1 FROM jobs WHERE id = %s FOR NO KEY UPDATE", (job_id,))


async def add_deliveries(connection: Connection, settings: Settings, job_id: str, to: DeliverTo) -> None:
    """Schedule files of a job, whose row is locked, to be sent after its end; a new address replaces the old one.

    Raises `InputError` (``address_refused``).
    """
    policy = Policy.of_files(settings)
    for name, url in to.addresses:
        try:
            host = checked_url(url, policy).host
        except InputError as error:
            raise InputError.of(error.fault, where=name or "archive") from None
        await connection.execute(
            "DELETE FROM job_deliveries WHERE job_id = %s AND name IS NOT DISTINCT FROM %s", (job_id, name)
        )
        await connection.execute(
            "INSERT INTO job_deliveries (id, job_id, name, url) VALUES (%s, %s, %s, %s)",
            (new_id("dl"), job_id, name, url),
        )
        await _note(connection, job_id, DeliveredFile(name=name, host=host))
    await connection.execute("SELECT pg_notify('biresnerf_webhooks', '')")


async def note_delivery(
    connection: Connection, job_id: str, name: str | None, host: str, error: JobError | None
) -> None:
    """Record that a file was delivered, or why not; changes nothing else of the job."""
    state = "delivered" if error is None else "failed"
    note = DeliveredFile(name=name, host=host, state=state, at=datetime.now(UTC), error=error)
    await _note(connection, job_id, note)


async def _note(connection: Connection, job_id: str, note: DeliveredFile) -> None:
    await connection.execute(
        "UPDATE jobs SET revision = revision + 1, updated_at = clock_timestamp(), delivered = %s || ("
        "SELECT coalesce(jsonb_agg(item), '[]') FROM jsonb_array_elements(delivered) AS item"
        " WHERE item ->> 'name' IS DISTINCT FROM %s) WHERE id = %s",
        (Jsonb([note.model_dump(mode="json")]), note.name, job_id),
    )
    await connection.execute("SELECT pg_notify('biresnerf_jobs', %s)", (job_id,))
