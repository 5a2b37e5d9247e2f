"""The job queues, kept by Procrastinate; no other module knows it.

We use its schema and its public `JobManager`, inside our own transactions. An entry of the queue is ``todo``,
``doing`` (a worker has it) or over. Its `Worker` is not used: its heartbeats run in the event loop, stop when a worker
begins to drain, and end the worker when the database is away; at its start it unregisters workers that an outage
kept silent; and it reports the end of a job without asking whether the entry is still its own. Each of these breaks a
promise (tests/workers/queue/test_heartbeat.py, test_fenced_worker.py, test_queue_contract.py). The loop of
`workers.queue.lane` takes its place.

Other SQL reads the queue through the views and writes it through the function that is defined here.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, LiteralString

from procrastinate.connector import BaseAsyncConnector
from procrastinate.jobs import Job, Status
from procrastinate.manager import JobManager
from procrastinate.schema import SchemaManager
from psycopg import AsyncCursor
from psycopg.rows import DictRow
from psycopg.types.json import Jsonb

from biresnerf.wire.jobs import JobKind
from workers.database.database import Connection

REFINEMENTS: JobKind = "refine"
EXPORTS: JobKind = "export"
KINDS = (REFINEMENTS, EXPORTS)  # each has a queue of its name: exports do not wait behind refinements
CHANNELS = tuple(f"procrastinate_queue_v1#{kind}" for kind in KINDS)
NEW_ENTRY = ""  # see `subject_of`
KEEP_ENTRIES_H = 24
ALWAYS = datetime(1970, 1, 1, tzinfo=UTC)
# When a held entry is due, unless `offer_queue_entry` is called.
NEVER = datetime(9999, 1, 1, tzinfo=UTC)

# Procrastinate's last migration in the oldest version that we allow. Newer ones are separate steps.
SCHEMA_STEP, SCHEMA_UNTIL = "000_procrastinate", "03.04.00_50_post_add_retry_failed_job_procedure"
_DROP_VIEWS = "DROP VIEW queue_entries, queue_workers;"
_INTERFACE = """
CREATE VIEW queue_entries AS
    SELECT id, args ->> 'job_id' AS job_id, status::text AS state, worker_id FROM procrastinate_jobs;
CREATE VIEW queue_workers AS SELECT id, last_heartbeat FROM procrastinate_workers;

-- Makes an entry due now, and wakes idle workers: Procrastinate notifies of new entries only.
CREATE OR REPLACE FUNCTION offer_queue_entry(_id bigint) RETURNS void LANGUAGE plpgsql AS $$
BEGIN
    UPDATE procrastinate_jobs SET scheduled_at = NULL WHERE id = _id AND status = 'todo';
    PERFORM pg_notify('procrastinate_queue_v1#' || queue_name,
        json_build_object('type', 'job_inserted', 'job_id', id)::text)
        FROM procrastinate_jobs WHERE id = _id;
END;
$$;
"""
# Also registers a worker again that was unregistered while it was frozen.
HEARTBEAT: LiteralString = (
    "INSERT INTO procrastinate_workers (id) OVERRIDING SYSTEM VALUE VALUES (%s)"
    " ON CONFLICT (id) DO UPDATE SET last_heartbeat = now()"
)


@dataclass(frozen=True)
class Entry:
    """A job in a queue; ``kind`` names the queue."""

    id: int
    job_id: str
    kind: JobKind


def schema_steps() -> list[tuple[str, str]]:
    """Name and SQL of the queue's schema, and of each migration that the installed version adds to it.

    On an empty database the first suffices: it includes the others.
    """
    files = sorted(Path(SchemaManager.get_migrations_path()).glob("*.sql"))
    later = [
        (f"{SCHEMA_STEP}_{file.stem}", f"{_DROP_VIEWS}\n{file.read_text()}\n{_INTERFACE}")
        for file in files
        if file.stem > SCHEMA_UNTIL
    ]
    return [(SCHEMA_STEP, f"{SchemaManager.get_schema()}\n{_INTERFACE}"), *later]


async def enqueue(connection: Connection, job_id: str, kind: JobKind, *, order: int, held: bool) -> int:
    """Add a job and return the entry's id.

    Within a kind, jobs of lower ``order`` run first; a ``held`` one waits for `offer_queue_entry`.
    """
    job = Job(
        queue=kind,
        task_name=kind,
        priority=-order,
        lock=None,
        queueing_lock=None,
        task_kwargs={"job_id": job_id},
        scheduled_at=NEVER if held else None,
    )
    added = await _manager(connection).defer_job_async(job)
    assert added.id is not None, "given by the database"
    return added.id


async def take(connection: Connection, worker_id: int, kinds: Sequence[JobKind] = KINDS) -> Entry | None:
    """The next due entry of ``kinds``, if any, for a worker that has none of them.

    An entry that the worker already holds comes first: the earlier answer was lost with the connection.
    """
    await connection.execute(HEARTBEAT, (worker_id,))
    held = await connection.rows(
        "SELECT id, args ->> 'job_id' AS job_id, queue_name AS kind FROM procrastinate_jobs"
        " WHERE worker_id = %s AND status = 'doing' AND queue_name = ANY (%s)",
        worker_id,
        list(kinds),
    )
    if held:
        return Entry(**held[0])
    job = await _manager(connection).fetch_job(queues=list(kinds), worker_id=worker_id)
    if job is None or job.id is None:
        return None
    return Entry(job.id, str(job.task_kwargs["job_id"]), EXPORTS if job.queue == EXPORTS else REFINEMENTS)


async def acknowledge(
    connection: Connection, entry_id: int, worker_id: int, *, again_in_s: float | None
) -> bool:
    """End the worker's hold on an entry: it is done, or due again in ``again_in_s`` seconds.

    Returns False, and changes nothing, if another worker holds the entry by now.
    """
    if not await lock_taken(connection, entry_id, worker_id):
        return False
    if again_in_s is None:
        await _manager(connection).finish_job_by_id_async(entry_id, Status.SUCCEEDED, delete_job=False)
    else:
        await put_back(connection, entry_id, again_in_s)
    return True


async def lock_taken(connection: Connection, entry_id: int, worker_id: int | None) -> bool:
    """Whether the worker, or any worker, holds the entry; locks it until the end of the transaction."""
    taken = (
        "SELECT 1 FROM procrastinate_jobs WHERE id = %s AND status = 'doing'"
        " AND (%s::bigint IS NULL OR worker_id = %s) FOR UPDATE"
    )
    return bool(await connection.rows(taken, entry_id, worker_id, worker_id))


async def put_back(connection: Connection, entry_id: int, in_s: float = 0) -> None:
    """Offer again an entry that a worker holds."""
    # By the database's clock, as the queue: a worker's own may be an hour off.
    later = "SELECT clock_timestamp() + make_interval(secs => %s)"
    due = await connection.value(later, in_s) if in_s else ALWAYS
    await _manager(connection).retry_job_by_id_async(entry_id, retry_at=due)
    if not in_s:
        await connection.execute("SELECT offer_queue_entry(%s)", (entry_id,))


async def abort(connection: Connection, entry_id: int) -> None:
    """Remove from the queue an entry that a dead worker holds."""
    await _manager(connection).finish_job_by_id_async(entry_id, Status.ABORTED, delete_job=False)


async def cancel(connection: Connection, entry_id: int) -> None:
    """Cancel an entry: remove it if it waits, else wake the worker that holds it (see `subject_of`)."""
    await _manager(connection).cancel_job_by_id_async(entry_id, abort=True)


def subject_of(notification: str) -> str:
    """The subject of a notification on `CHANNELS`: `NEW_ENTRY`, or the id of an entry to cancel."""
    content = json.loads(notification)
    return NEW_ENTRY if content["type"] == "job_inserted" else str(content["job_id"])


async def register_worker(connection: Connection) -> int:
    """Register a new worker; it has to send heartbeats (`HEARTBEAT`) from now on."""
    return await _manager(connection).register_worker()


async def unregister_worker(connection: Connection, worker_id: int | None) -> None:
    """Unregister a worker, or all of them."""
    await connection.execute("DELETE FROM procrastinate_workers WHERE id = coalesce(%s, id)", (worker_id,))


async def entries_of_worker(connection: Connection, worker_id: int | None) -> list[int]:
    """Entries that the worker, or any worker, holds, in locking order."""
    rows = await connection.rows(
        "SELECT id FROM procrastinate_jobs WHERE status = 'doing'"
        " AND (%s::bigint IS NULL OR worker_id = %s) ORDER BY id",
        *(worker_id, worker_id),
    )
    return [row["id"] for row in rows]


async def unregister_silent_workers(connection: Connection, silent_s: float) -> None:
    """Unregister workers that sent no heartbeat for ``silent_s``."""
    await _manager(connection).prune_stalled_workers(silent_s)


async def entries_of_silent_workers(connection: Connection, silent_s: float) -> list[int]:
    """Entries whose worker is not registered, or sent no heartbeat for ``silent_s``."""
    stalled = await _manager(connection).get_stalled_jobs(seconds_since_heartbeat=silent_s)
    return sorted(job.id for job in stalled if job.id is not None)


async def delete_old_entries(connection: Connection) -> None:
    """Delete entries that ended more than a day ago."""
    await _manager(connection).delete_old_jobs(
        KEEP_ENTRIES_H, include_failed=True, include_cancelled=True, include_aborted=True
    )


class _InTransaction(BaseAsyncConnector):
    """Runs the engine's queries on a connection of ours. Errors are psycopg's own."""

    def __init__(self, connection: Connection) -> None:
        self._connection = connection

    async def execute_query_async(self, query: LiteralString, **arguments: Any) -> None:
        await self._run(query, arguments)

    async def execute_query_one_async(self, query: LiteralString, **arguments: Any) -> dict[str, Any]:
        row = await (await self._run(query, arguments)).fetchone()
        assert row is not None, "asked only of queries that give a row"
        return row

    async def execute_query_all_async(self, query: LiteralString, **arguments: Any) -> list[dict[str, Any]]:
        return await (await self._run(query, arguments)).fetchall()

    async def _run(self, query: LiteralString, arguments: Mapping[str, Any]) -> AsyncCursor[DictRow]:
        return await self._connection.execute(
            query, {name: _adapted(value) for name, value in arguments.items()}
        )


def _manager(connection: Connection) -> JobManager:
    return JobManager(_InTransaction(connection))


def _adapted(value: Any) -> Any:
    """The arguments with dicts as JSON."""
    if isinstance(value, dict):
        return Jsonb(value)
    if isinstance(value, list):
        return [_adapted(item) for item in value]
    return tuple(map(_adapted, value)) if isinstance(value, tuple) else value
