"""Copies of one job and its dataset, which fill a database, and the regular operations to try on it."""

from __future__ import annotations

from collections.abc import Awaitable, Callable

from psycopg import sql

from biresnerf.options.refine_options import RefineOptions
from workers.database import job_queue
from workers.database.database import Database
from workers.database.statistics import read_statistics
from workers.engine import Stores
from workers.jobs.claim import claim_job
from workers.jobs.ledger import Ledger
from workers.queue.janitor import Janitor
from workers.settings.settings import Settings
from workers.tenants.token_buckets import TokenBuckets
from workers.upkeep.expiry import Expiry

TABLES = ("datasets", "dataset_files", "jobs", "job_events", "job_log")
# Copies differ in these from their original; `copy` is their number. They ended within the last day.
CHANGED = {
    "datasets": {
        "id": "'ds_copy' || copy",
        "touched_at": "now() - make_interval(secs => 86100 - copy * 0.8)",
        "created_at": "now() - make_interval(secs => 86100 - copy * 0.8)",
    },
    "dataset_files": {"dataset_id": "'ds_copy' || copy"},
    "jobs": {
        "id": "'job_copy' || copy",
        "dataset_id": "'ds_copy' || copy",
        "idempotency_key": "'copy' || copy",
        "created_at": "now() - make_interval(secs => 86000 - copy * 0.8)",
        "finished_at": "now() - make_interval(secs => 85950 - copy * 0.8)",
        "labels": "jsonb_build_object('set', (copy / 10)::text)",
        "state": "CASE WHEN copy % 1000 = 0 THEN 'failed' ELSE 'succeeded' END",
    },
    "job_events": {"job_id": "'job_copy' || copy"},
    "job_log": {"job_id": "'job_copy' || copy"},
}
ROWS_OF_INTEREST = 500
Operation = Callable[[], Awaitable[object]]


class Copies:
    """Copies the rows of one job and its dataset."""

    def __init__(self, database: Database, job_id: str) -> None:
        self._database, self._job_id, self.made = database, job_id, 0

    async def make(self, until: int) -> None:
        """As many as there are to be."""
        (job,) = await self._database.fetch("SELECT dataset_id FROM jobs WHERE id = %s", self._job_id)
        for table in TABLES:
            key = "id" if table in ("datasets", "jobs") else "dataset_id" if "dataset" in table else "job_id"
            original = job["dataset_id"] if table.startswith("dataset") else self._job_id
            for first in range(self.made + 1, until + 1, 10_000):
                await self._copy(table, key, original, first, min(until, first + 9_999))
        self.made = until

    async def _copy(self, table: str, key: str, original: str, first: int, last: int) -> None:
        rows = await self._database.fetch(
            "SELECT column_name AS name FROM information_schema.columns WHERE table_name = %s"
            " AND table_schema = current_schema() AND is_generated = 'NEVER'",
            table,
        )
        names = [row["name"] for row in rows]
        values = [
            sql.SQL(CHANGED[table][name]) if name in CHANGED[table] else sql.Identifier("one", name)
            for name in names
        ]
        statement = sql.SQL(
            "INSERT INTO {table} ({names}) SELECT {values} FROM {table} AS one, generate_series({first}, {last}) copy"
            " WHERE one.{key} = {original}"
        ).format(
            table=sql.Identifier(table),
            names=sql.SQL(", ").join(map(sql.Identifier, names)),
            values=sql.SQL(", ").join(values),
            first=sql.Literal(first),
            last=sql.Literal(last),
            key=sql.Identifier(key),
            original=sql.Literal(original),
        )
        async with self._database.transaction() as connection:
            # No triggers: what the copies were counted for was counted for their original.
            await connection.execute("SET LOCAL session_replication_role = replica")
            await connection.execute(statement)


async def rows_scanned(database: Database, operation: Operation, times: int) -> dict[str, int]:
    """Rows that scans of whole tables read each time, by table, where they are many."""
    await operation()
    before = await scanned(database)
    for _ in range(times):
        await operation()
    read = {name: (rows - before.get(name, 0)) / times for name, rows in (await scanned(database)).items()}
    return {name: round(rows) for name, rows in read.items() if rows > ROWS_OF_INTEREST}


async def scanned(database: Database) -> dict[str, int]:
    """Rows that scans of whole tables have read so far."""
    await database.fetch("SELECT pg_stat_force_next_flush()")
    rows = await database.fetch(
        "SELECT relname AS name, seq_tup_read AS read FROM pg_stat_user_tables WHERE schemaname = current_schema()"
    )
    return {row["name"]: row["read"] for row in rows}


class Operations:
    """What happens every hour, on one connection, so that the database's counts are complete."""

    def __init__(self, database: Database, stores: Stores, settings: Settings, dataset: str) -> None:
        self._database, self._dataset = database, dataset
        self._jobs = stores.jobs.for_tenant("local")
        self._jobs._database = database
        self._janitor = Janitor(database, stores.files, settings)
        self._expiry = Expiry(database, settings)
        self._buckets = TokenBuckets(database)
        self._worker = 0

    def all(self) -> dict[str, Operation]:
        """By name."""
        return {
            "submit": self._submit,
            "take, claim, end a job": self.work,
            "look at a waiting job": self._look,
            "list 50": self._jobs.list,
            "list 50 that failed": lambda: self._jobs.list(state="failed"),
            "list by a label": lambda: self._jobs.list(label=("set", "x")),
            "count by state (/v1/info)": self._jobs.counts,
            "bytes of a tenant": lambda: self._database.fetch("SELECT stored_bytes_of('local')"),
            "queue_depth": lambda: self._database.fetch("SELECT * FROM queue_depth"),
            "metrics": lambda: read_statistics(self._database, 60.0),
            "janitor's round": self._janitor._round,
            "expiry's round": self._expiry.round,
            "rate limit": lambda: self._buckets.take("requests", "somebody", 1000.0, 1000),
        }

    async def _submit(self) -> None:
        job, _ = await self._jobs.submit(self._dataset, RefineOptions(preset="fast"))
        self._newest = job.id

    async def _look(self) -> None:
        await self._jobs.get(self._newest)

    async def work(self) -> None:
        """One job through the queue, without a process."""
        self._worker = self._worker or await self._database.run(job_queue.register_worker)
        entry = await self._database.run(job_queue.take, self._worker)
        assert entry is not None, "jobs wait"
        claim = await claim_job(self._database, entry.job_id, self._worker, 3, 60.0)
        assert claim is not None, "it waited"
        await Ledger(self._database, claim, 60.0).publish([], None)
        async with self._database.transaction() as connection:
            await job_queue.acknowledge(connection, entry.id, self._worker, again_in_s=None)
