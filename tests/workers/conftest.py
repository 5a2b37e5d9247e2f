"""A real private PostgreSQL for the run, a fresh schema for each test, real slot processes."""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import uuid
from collections.abc import AsyncIterator, Callable, Iterator, Sequence
from pathlib import Path

import psutil
import psycopg
import pytest
from psycopg import sql
from psycopg.conninfo import make_conninfo

from biresnerf.options.refine_options import RefineOptions
from biresnerf.wire.jobs import JobDetails, JobKind, JobView
from workers.database import job_queue
from workers.database.database import Database
from workers.database.embedded_postgres import EmbeddedPostgres
from workers.database.job_queue import Entry
from workers.database.migrate import migrate
from workers.engine import Stores, open_stores
from workers.jobs.claim import Claim, claim_job
from workers.settings.errors import Unavailable
from workers.settings.settings import Settings

ROOT = Path(__file__).parents[2]
PROGRAM = Path(__file__).with_name("counting_program.py")
PATIENCE_S = 90.0
SHORT_STALL = {"stall_s": 1.5}
# The end of a check program that accepts the files.
_FOUND = {
    **{"images": 1, "with_pose": 1, "without_pose": 0, "poses": "given", "cameras": 1},
    **{"camera_models": ["PINHOLE"], "intrinsics": ["given"], "format": "colmap"},
    **{"masks": 0, "transparency": False, "warnings": []},
}
ACCEPTED = f"print({json.dumps({'report': _FOUND})!r})"


@pytest.fixture
def anyio_backend() -> str:
    return "asyncio"


@pytest.fixture(scope="session")
def server() -> Iterator[str]:
    """Address of a private server for the whole run."""
    with short_folder() as folder:
        postgres = EmbeddedPostgres(folder / "postgres")
        yield postgres.start()
        assert postgres.process is not None
        postgres.process.send_signal(
            signal.SIGQUIT
        )  # at once: writing dozens of databases to disk takes long
        postgres.process.wait()
        postgres.stop()


@contextlib.contextmanager
def short_folder() -> Iterator[Path]:
    """A folder that PostgreSQL's user can reach; pytest's own are 0700, and of root where root runs the tests."""
    memory = Path("/dev/shm")  # where there is enough of it: a database on a busy disk makes the tests crawl
    roomy = memory.is_dir() and os.access(memory, os.W_OK) and shutil.disk_usage(memory).free > 2 * 2**30
    folder = Path(tempfile.mkdtemp(prefix="biresnerf-test-", dir=memory if roomy else None))
    folder.chmod(0o711)
    try:
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)


@pytest.fixture
def database_url(server: str) -> str:
    """A schema of its own, migrated: much cheaper than a database of its own."""
    name = f"t{uuid.uuid4().hex[:12]}"
    with psycopg.connect(server, autocommit=True) as connection:
        connection.execute(f"CREATE SCHEMA {name}".encode())
    url = f"{server}&options=-csearch_path%3D{name}"
    migrate(url)
    return url


@pytest.fixture
def scaler(database_url: str) -> Iterator[psycopg.Connection]:
    """A connection of a role with the right to read the view alone."""
    role = f"scaler_{uuid.uuid4().hex[:12]}"
    with psycopg.connect(database_url, autocommit=True) as owner:
        schema = owner.execute("SELECT current_schema()").fetchone()[0]
        for statement in (
            "CREATE ROLE {role} LOGIN",
            "GRANT USAGE ON SCHEMA {schema} TO {role}",
            "GRANT SELECT ON queue_depth TO {role}",
        ):
            owner.execute(sql.SQL(statement).format(role=sql.Identifier(role), schema=sql.Identifier(schema)))
        with psycopg.connect(make_conninfo(database_url, user=role), autocommit=True) as connection:
            yield connection
        for statement in ("DROP OWNED BY {role}", "DROP ROLE {role}"):
            owner.execute(sql.SQL(statement).format(role=sql.Identifier(role)))


@pytest.fixture
def settings(database_url: str, tmp_path: Path) -> Settings:
    return quick_settings(tmp_path / "data", database_url=database_url)


def quick_settings(data_dir: Path, **changes: object) -> Settings:
    """Everything that production waits for, in tenths of a second; jobs count.

    But for the stall time, after which the database also ends transactions in which nothing happens: on a starved
    machine every process is silent for seconds. Tests of what happens after it set `SHORT_STALL`.
    """
    values = {
        "data_dir": data_dir,
        "beat_s": 0.3,
        "stall_s": 20.0,
        "poll_s": 0.3,
        "janitor_s": 0.3,
        "stop_grace_s": 5.0,
        "job_nice": 0,  # tests wait for jobs, whatever else the machine does
        "job_command": (sys.executable, str(PROGRAM)),
        "check_command": (sys.executable, "-c", ACCEPTED),
    }
    return Settings(**{**values, **changes})


@pytest.fixture
async def stores(settings: Settings) -> AsyncIterator[Stores]:
    async with open_stores(settings) as opened:
        yield opened


def environment(settings: Settings) -> dict[str, str]:
    """The settings as a process of its own finds them."""
    said = {}
    for name, value in settings.model_dump(mode="json", exclude_none=True).items():
        said[f"BIRESNERF_{name.upper()}"] = value if isinstance(value, str) else json.dumps(value)
    return {**os.environ, **said, "PYTHONPATH": str(ROOT)}


class Slots:
    """Starts slot processes and makes sure that none outlives the test."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self.processes: list[subprocess.Popen[bytes]] = []

    def start(self, settings: Settings, name: str) -> subprocess.Popen[bytes]:
        return self.run(
            settings,
            [sys.executable, "-m", "workers.queue.slot", "--slot", name],
            self._folder / f"slot-{name}.log",
        )

    def run(self, settings: Settings, command: list[str], log: Path) -> subprocess.Popen[bytes]:
        with log.open("ab") as output:
            process = subprocess.Popen(
                command, env=environment(settings), stdout=output, stderr=output, start_new_session=True
            )
        self.processes.append(process)
        return process

    def end(self) -> None:
        for process in self.processes:
            with contextlib.suppress(ProcessLookupError):
                os.kill(process.pid, signal.SIGCONT)
                os.kill(process.pid, signal.SIGKILL)
            process.wait()


@pytest.fixture
def slots(tmp_path: Path) -> Iterator[Slots]:
    started = Slots(tmp_path)
    yield started
    started.end()


async def _one_chunk(content: bytes) -> AsyncIterator[bytes]:
    yield content


async def ready_dataset(stores: Stores, files: dict[str, bytes]) -> str:
    dataset = await stores.datasets.create("test")
    for path, content in files.items():
        await stores.datasets.add_file(dataset.id, path, _one_chunk(content))
    await stores.datasets.finalize(dataset.id)
    checked = await stores.datasets.check(dataset.id)
    assert checked.state == "ready", checked.error
    return dataset.id


async def taken_by_somebody(database: Database, kinds: Sequence[JobKind] = job_queue.KINDS) -> Entry:
    """The next entry of the queue, which a new worker has now."""
    async with database.transaction() as connection:
        entry = await job_queue.take(connection, await job_queue.register_worker(connection), kinds)
    assert entry is not None
    return entry


async def claimed(database: Database, job_id: str, stall_s: float = 60.0) -> Claim | None:
    """A claim by the worker that has the job's entry."""
    having = "SELECT worker_id FROM queue_entries WHERE job_id = %s AND state = 'doing'"
    (row,) = await database.fetch(having, job_id)
    return await claim_job(database, job_id, row["worker_id"], 3, stall_s)


@pytest.fixture
async def dataset_id(stores: Stores) -> str:
    return await ready_dataset(stores, {"plan.json": b"{}"})


class Counting:
    """A job of `counting_program` and the journal of its starts."""

    def __init__(self, stores: Stores, journal: Path) -> None:
        self.stores, self._journal = stores, journal
        self.id = ""

    async def submit(
        self, steps: int, step_s: float, *, details: JobDetails | None = None, **faults: object
    ) -> str:
        plan = {"steps": steps, "step_s": step_s, "journal": str(self._journal), **faults}
        dataset_id = await ready_dataset(self.stores, {"plan.json": json.dumps(plan).encode()})
        job, _ = await self.stores.jobs.submit(dataset_id, RefineOptions(preset="fast"), **(details or {}))
        self.id = job.id
        return job.id

    async def assert_one_result(self, steps: int) -> None:
        """Published once, from one attempt, complete."""
        events = await self.events()
        assert events.count("succeeded") == 1
        assert (await self.result())["steps"] == steps
        artifacts = await self.stores.jobs.artifacts(self.id)
        assert {item.name for item in artifacts} == {"log.txt", "renders/one.png", "report.json"}
        assert len({item.key.split("/")[3] for item in artifacts}) == 1
        sequence = [event.seq for event in (await self.stores.jobs.update(self.id)).events]
        assert sequence == list(range(1, len(sequence) + 1))

    async def until(self, holds: Callable[[JobView], bool], timeout_s: float = PATIENCE_S) -> JobView:
        """The job once ``holds``; fails the test after the timeout. A client tries again after a 503."""
        end = time.monotonic() + timeout_s
        while True:
            try:
                return await self._until(holds, end)
            except Unavailable:
                assert time.monotonic() < end, "the database did not come back"
                await asyncio.sleep(0.1)

    async def _until(self, holds: Callable[[JobView], bool], end: float) -> JobView:
        async for update in self.stores.jobs.subscribe(self.id, heartbeat_s=1.0):
            if update is not None and holds(update.job):
                return update.job
            assert time.monotonic() < end, f"waited too long: {update}"
        raise AssertionError(f"the job ended otherwise: {await self.stores.jobs.get(self.id)}")

    async def until_final(self, timeout_s: float = PATIENCE_S) -> JobView:
        return await self.until(lambda job: job.final, timeout_s)

    async def nobodys_files(self) -> list[str]:
        """Stored files of the job that nothing refers to and no janitor will delete."""
        database = self.stores.jobs._database
        rows = await database.fetch(
            "SELECT prefix, keep FROM trash WHERE prefix LIKE %s", f"jobs/{self.id}/%"
        )
        known = {row["key"] for row in await database.fetch("SELECT key FROM job_file_keys")}
        going = [(f"{row['prefix']}/", f"{row['prefix']}/{row['keep']}/") for row in rows]
        keys = [file.key for file in await self.stores.files.list(f"jobs/{self.id}")]
        return [
            key
            for key in keys
            if key not in known
            and not any(key.startswith(prefix) and not key.startswith(keep) for prefix, keep in going)
        ]

    def starts(self) -> list[dict[str, object]]:
        return (
            [json.loads(line) for line in self._journal.read_text().splitlines()]
            if self._journal.exists()
            else []
        )

    async def events(self) -> list[str]:
        return [event.type for event in (await self.stores.jobs.update(self.id)).events]

    async def result(self) -> dict[str, object]:
        """The published report, read from the store."""
        (artifact,) = [
            item for item in await self.stores.jobs.artifacts(self.id) if item.name == "report.json"
        ]
        return json.loads(b"".join([chunk async for chunk in self.stores.files.read(artifact.key)]))


@pytest.fixture
def counting(stores: Stores, tmp_path: Path) -> Counting:
    return Counting(stores, tmp_path / "journal")


async def died(process: psutil.Process) -> None:
    """Until the process is gone, or waits for nothing but its parent to notice."""
    end = time.monotonic() + PATIENCE_S
    with contextlib.suppress(psutil.NoSuchProcess):
        while process.is_running() and process.status() != psutil.STATUS_ZOMBIE:
            assert time.monotonic() < end, process
            await asyncio.sleep(0.05)
