"""Checks what the service needs, and reads the figures of the whole installation."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable
from typing import Literal

from biresnerf.wire.operator import FailedJob, OperatorView, PriorityCount, RunningJob, SlotView
from workers.database.database import Database
from workers.database.migrate import step_names
from workers.database.statistics import LIVING, Statistics, read_statistics
from workers.records import PRIORITIES, record_from_row
from workers.settings.errors import Unavailable
from workers.store.files import FileStore

Need = Literal["database", "storage", "queue"]
# A probe must answer before its caller gives up.
CHECK_S = 2.0
FAILURES_SHOWN = 20
_SLOTS = """
    SELECT slots.host, slots.name, slots.kind, worker.last_heartbeat AS beat_at,
        worker.last_heartbeat > now() - make_interval(secs => %s) AS alive,
        coalesce(jsonb_agg(to_jsonb(job) ORDER BY job.since) FILTER (WHERE job.id IS NOT NULL), '[]') AS jobs
    FROM slots JOIN queue_workers AS worker ON worker.id = slots.worker_id
    LEFT JOIN queue_entries AS entry ON entry.worker_id = worker.id AND entry.state = 'doing'
    LEFT JOIN running_jobs AS job ON job.queue_id = entry.id
    GROUP BY 1, 2, 3, 4 ORDER BY 1, 2"""
_SIZES = """
    SELECT clock_timestamp() AS at, (SELECT sum(stored_bytes_of(id)) FROM tenants)::bigint AS stored_bytes,
        pg_database_size(current_database()) AS database_bytes, (SELECT count(*) FROM trash) AS trash,
        (SELECT count(*) FROM webhook_deliveries WHERE state = 'pending') AS webhooks_pending"""
_FAILURES = "SELECT * FROM failed_jobs ORDER BY finished_at DESC LIMIT %s"


class Monitor:
    """Read-only monitoring. Get one from `workers.engine.open_stores`."""

    def __init__(self, database: Database, files: FileStore, stall_s: float) -> None:
        self._database, self._files, self._stall_s = database, files, stall_s

    @property
    def broken(self) -> asyncio.Event:
        """Set once this process has lost database connections for good."""
        return self._database.broken

    async def statistics(self) -> Statistics:
        """The figures; raises `Unavailable`."""
        return await read_statistics(self._database, self._stall_s)

    async def overview(self) -> OperatorView:
        """The operator's view of the installation; raises `Unavailable`."""
        async with self._database.transaction() as connection:
            await connection.execute("SET TRANSACTION ISOLATION LEVEL REPEATABLE READ READ ONLY")
            counts = {row["priority"]: row for row in await connection.rows("SELECT * FROM unfinished_jobs")}
            slots = await connection.rows(_SLOTS, self._stall_s)
            failures = await connection.rows(_FAILURES, FAILURES_SHOWN)
            sizes = await connection.only_row(_SIZES)
        return OperatorView(
            queue=tuple(
                record_from_row(PriorityCount, counts.get(PRIORITIES[name], {}), priority=name)
                for name in ("high", "normal", "low")
            ),
            slots=tuple(
                record_from_row(SlotView, row, jobs=[record_from_row(RunningJob, job) for job in row["jobs"]])
                for row in slots
            ),
            failures=tuple(FailedJob(**row) for row in failures),
            **sizes,
        )

    async def living_workers(self) -> int:
        """Worker slots that sent a heartbeat within the stall time; raises `Unavailable`."""
        (row,) = await self._database.fetch(f"SELECT count(*) AS n FROM {LIVING}", self._stall_s)
        return int(row["n"])

    async def lacking(self) -> dict[Need, str]:
        """What is unavailable, and why; empty if jobs can be accepted. Returns within seconds."""
        needs: dict[Need, Awaitable[str]] = {
            "database": self._database_problem(),
            "storage": self._storage_problem(),
            "queue": self._queue_problem(),
        }
        found = await asyncio.gather(*(_in_time(need) for need in needs.values()))
        return {need: why for need, why in zip(needs, found, strict=True) if why}

    async def _database_problem(self) -> str:
        await self._database.fetch("SELECT 1")
        return ""

    async def _storage_problem(self) -> str:
        return "" if await self._files.healthy() else "Files cannot be written."

    async def _queue_problem(self) -> str:
        await self._database.fetch("SELECT 1 FROM queue_entries LIMIT 1")
        done = {row["name"] for row in await self._database.fetch("SELECT name FROM schema_steps")}
        missing = [name for name in step_names() if name not in done]
        return f"The database lacks {', '.join(missing)}: run `biresnerf migrate`." if missing else ""


async def _in_time(check: Awaitable[str]) -> str:
    asked = asyncio.ensure_future(check)
    # Cancelling a query sends a request to the server, which may be frozen: do not wait for it.
    asked.add_done_callback(lambda done: done.cancelled() or done.exception())
    try:
        await asyncio.wait({asked}, timeout=CHECK_S)
        return await asked if asked.done() else f"No answer within {CHECK_S:g} s."
    except Unavailable as error:
        return error.detail
    finally:
        asked.cancel()
