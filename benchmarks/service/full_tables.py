"""What a full database costs: ``python -m benchmarks.service.full_tables``.

One job is run for real and its rows are copied: to 1,000 jobs that are over and 100 that wait, then to 100,000 and
10,000. At each size the operations of every hour are timed with the product's own code, and the rows counted that the
database reads by scanning whole tables while they run.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import random
import shutil
import statistics
import subprocess
import sys
import time
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

from psycopg import sql

from benchmarks.chaos.__main__ import new_folder
from benchmarks.chaos.installation import REAL_PROGRAMS, Installation
from benchmarks.chaos.real_clients import RealClients
from benchmarks.load.parts import fill
from biresnerf.options.refine_options import RefineOptions
from workers.database import job_queue
from workers.database.database import Database, open_database
from workers.database.statistics import read_statistics
from workers.engine import Stores, open_stores
from workers.jobs.claim import claim_job
from workers.jobs.ledger import Ledger
from workers.queue.janitor import Janitor
from workers.settings.settings import Settings
from workers.tenants.token_buckets import TokenBuckets
from workers.upkeep.expiry import Expiry

SIZES = ((1_000, 100), (100_000, 10_000))
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
Figures = dict[str, Any]
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


async def vacuum(database: Database) -> None:
    """As it would be after a while."""
    async with database.pool.connection() as connection:
        await connection.set_autocommit(True)
        await connection.execute("VACUUM ANALYZE")
        await connection.set_autocommit(False)


async def table_sizes(database: Database) -> dict[str, int]:
    """Bytes of each table with its indexes."""
    rows = await database.fetch(
        "SELECT relname AS name, pg_total_relation_size(relid) AS bytes FROM pg_stat_user_tables"
        " WHERE schemaname = current_schema()"
    )
    return {row["name"]: row["bytes"] for row in rows if row["bytes"] > 2**16}


async def scanned(database: Database) -> dict[str, int]:
    """Rows that scans of whole tables have read so far."""
    await database.fetch("SELECT pg_stat_force_next_flush()")
    rows = await database.fetch(
        "SELECT relname AS name, seq_tup_read AS read FROM pg_stat_user_tables WHERE schemaname = current_schema()"
    )
    return {row["name"]: row["read"] for row in rows}


async def timed(database: Database, operation: Operation, times: int) -> Figures:
    """The median and the longest time in milliseconds, and rows scanned each time where they are many."""
    await operation()
    before, took = await scanned(database), []
    for _ in range(times):
        began = time.perf_counter()
        await operation()
        took.append(1000 * (time.perf_counter() - began))
    read = {name: (rows - before.get(name, 0)) / times for name, rows in (await scanned(database)).items()}
    much = {name: round(rows) for name, rows in read.items() if rows > ROWS_OF_INTEREST}
    return {"ms": round(statistics.median(took), 2), "longest_ms": round(max(took), 2), "scanned": much}


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


async def real_job(installation: Installation, folder: Path) -> tuple[str, str]:
    """A job that ran, and its dataset."""
    clients = RealClients(installation.ports, folder, random.Random(1))
    await clients.prepare()
    await clients.run(1, 1)
    (seen,) = clients.seen
    if seen.job["state"] != "succeeded" or seen.faults:
        raise RuntimeError(f"the job is {seen.job['state']}: {seen.faults} {seen.job['error']}")
    return seen.job["id"], seen.job["dataset_id"]


def one_job_workers(installation: Installation, times: int) -> Figures:
    """Seconds from the start of a process for one job to its end; its job does nothing."""
    environment = installation.environment() | {
        "BIRESNERF_JOB_COMMAND": json.dumps([sys.executable, "-I", "-S", "-c", "pass"])
    }
    command = [sys.executable, "-m", "workers.queue.slot", "--free-slot", "cpu", "--one-job"]
    took = []
    for _ in range(times):
        began = time.perf_counter()
        subprocess.run(command, env=environment, check=True, capture_output=True)
        took.append(time.perf_counter() - began)
    return {"seconds": round(statistics.median(took), 2), "longest": round(max(took), 2)}


@asynccontextmanager
async def prepared(folder: Path) -> AsyncIterator[tuple[Installation, str, str]]:
    """An installation in which one job has run, without its workers."""
    installation = Installation(folder, 1, 1, **REAL_PROGRAMS, stall_s=60.0, max_queued=10**6)
    async with installation:
        job, dataset = await real_job(installation, folder)
        await installation.remove(installation.workers[0])
        yield installation, job, dataset


async def measure(folder: Path, times: int, share: float) -> Figures:
    """At each size."""
    found: Figures = {}
    async with prepared(folder) as (installation, job, dataset):
        url = installation.postgres.url
        async with (
            open_stores(installation.settings) as stores,
            open_database(url, connections=1, answer_s=600.0, silence_s=600.0) as database,
        ):
            copies, waiting = Copies(database, job), 0
            for table in ("job_events", "job_log"):
                (row,) = await database.fetch(f"SELECT count(*) AS n FROM {table} WHERE job_id = %s", job)
                found[f"{table} of a job"] = row["n"]
            empty = await table_sizes(database)
            for over, wait in [(round(share * over), round(share * wait)) for over, wait in SIZES]:
                began = time.perf_counter()
                await copies.make(over)
                await Expiry(database, installation.settings).round()  # gives them their dates
                await vacuum(database)
                sizes = await table_sizes(database)
                await fill(database, dataset, wait, first=waiting)
                waiting = wait
                sys.stdout.write(
                    f"\n{over} over, {wait} waiting (made in {time.perf_counter() - began:.0f} s)\n"
                )
                mib = {name: round((size - empty.get(name, 0)) / 2**20, 1) for name, size in sizes.items()}
                figures: Figures = {"mib": mib, "mib_in_all": round(sum(mib.values()), 1)}
                sys.stdout.write(f"  MiB of those that are over: {figures['mib_in_all']} {mib}\n")
                operations = Operations(database, stores, installation.settings, dataset)
                for name, operation in operations.all().items():
                    figures[name] = await timed(database, operation, times)
                    sys.stdout.write(f"  {name:28} {figures[name]}\n")
                    sys.stdout.flush()
                found[f"{over} over, {wait} waiting"] = figures
        found["worker for one job"] = await asyncio.to_thread(one_job_workers, installation, 5)
        sys.stdout.write(f"worker for one job: {found['worker for one job']}\n")
    return found


def main() -> int:
    parser = argparse.ArgumentParser(description="What the operations of every hour cost in a full database.")
    parser.add_argument("--times", type=int, default=20, help="Of each operation.")
    parser.add_argument("--share", type=float, default=1.0, help="Of the numbers of jobs, for a try.")
    parser.add_argument("--output", type=Path, default=Path("full_tables.json"))
    asked = parser.parse_args()
    folder = new_folder()
    try:
        found = asyncio.run(measure(folder, asked.times, asked.share))
    finally:
        shutil.rmtree(folder, ignore_errors=True)
    asked.output.write_text(json.dumps(found, indent=1) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
