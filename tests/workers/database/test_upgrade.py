"""A filled database of the first release is migrated, and API and workers go on with what is in it."""

from __future__ import annotations

import asyncio
import hashlib
import json
import sys
import uuid
from pathlib import Path

import psycopg
import pytest
from psycopg.types.json import Jsonb

from biresnerf.options.refine_options import RefineOptions
from tests.workers.conftest import PROGRAM, SHORT_STALL, Counting, Slots, quick_settings
from tests.workers.queue.test_exports_beside import EXPORTS
from workers.database import job_queue, migrate
from workers.engine import Stores, open_stores
from workers.settings.errors import Unavailable
from workers.settings.settings import Settings
from workers.store.files import open_files

pytestmark = pytest.mark.anyio
FIRST = ("0.1/1_tables", "0.1/2_functions")
STEPS = 12
FINAL = {
    "succeeded": {"finished_at": "now", "artifacts": ["report.json", "poses.json"], "attempt": 1},
    "failed": {"finished_at": "now", "error": {"code": "diverged", "detail": "x"}, "attempt": 3},
    "cancelled": {"finished_at": "now", "cancel_requested": True},
    "expired": {"finished_at": "now"},
}
QUEUE_STATES = {"queued": "todo", "running": "doing", "cancelled": "cancelled"}


class OldInstallation:
    """Rows as the first release wrote them, and the files that they name."""

    def __init__(self, settings: Settings, connection: psycopg.Connection, journal: Path) -> None:
        self.files, self._connection, self._journal = open_files(settings), connection, journal

    def insert(self, table: str, **columns: object) -> None:
        values = [Jsonb(value) if isinstance(value, (dict, list)) else value for value in columns.values()]
        names, places = ", ".join(columns), ", ".join(["%s"] * len(columns))
        self._connection.execute(f"INSERT INTO {table} ({names}) VALUES ({places})".encode(), values)

    async def file(self, key: str, content: bytes) -> dict[str, object]:
        stored = await self.files.put_bytes(key, content)
        digest = hashlib.sha256(content).hexdigest()
        return {
            "name": key.rpartition("/")[2],
            "key": key,
            "size": stored.size,
            "sha256": digest,
            "media_type": "",
        }

    async def dataset(self, name: str, tenant: str = "local", state: str = "ready") -> str:
        plan = json.dumps({"steps": STEPS, "step_s": 0.01, "journal": str(self._journal / name)}).encode()
        self.insert("datasets", id=name, tenant=tenant, name=name, state=state)
        file = await self.file(f"datasets/{name}/files/plan.json", plan)
        row = {name: file[name] for name in ("key", "size", "sha256")}
        self.insert("dataset_files", dataset_id=name, path="plan.json", **row)
        return name

    async def job(
        self, name: str, state: str, dataset: str = "ds_local", worker: int | None = None, **columns: object
    ) -> None:
        """With its place in the queue, its history and, if it names one, its checkpoint."""
        row = {
            "id": name,
            "dataset_id": dataset,
            "state": state,
            "options": {"preset": "fast"},
            "fingerprint": name,
        }
        row |= {**FINAL.get(state, {}), **columns}
        row["artifacts"] = [
            await self.file(f"jobs/{name}/results/1-x/{file}", b"{}") for file in row.get("artifacts", [])
        ]
        if "checkpoint" in row:
            row["checkpoint"] = {
                "prefix": f"jobs/{name}/checkpoints/1-x-1",
                "files": ["checkpoint/latest.json"],
            }
            saved = json.dumps({"step": 5, "chain": ""}).encode()
            await self.file(f"jobs/{name}/checkpoints/1-x-1/checkpoint/latest.json", saved)
        self.insert("jobs", **row)
        self.insert(
            "procrastinate_jobs",
            **{"queue_name": "refine", "task_name": "refine", "args": {"job_id": name}, "worker_id": worker},
            status=QUEUE_STATES.get(state, "succeeded"),
        )
        self._connection.execute(
            "UPDATE jobs SET queue_id = (SELECT max(id) FROM procrastinate_jobs) WHERE id = %s", (name,)
        )
        self._connection.execute(
            "UPDATE procrastinate_jobs SET scheduled_at = %s FROM jobs WHERE queue_id = procrastinate_jobs.id"
            " AND held AND jobs.id = %s",
            (job_queue.NEVER, name),
        )
        events = {"queued": ["queued"], "running": ["queued", "started"]}
        for event in events.get(state, ["queued", "started", state]):
            self._connection.execute("SELECT add_job_event(%s, %s, '{}')", (name, event))

    async def fill(self) -> None:
        self.insert("tenants", id="anna", max_running=1)
        self.insert(
            "api_keys",
            id="key_1",
            tenant="anna",
            name="laptop",
            prefix="abcdefgh",
            sha256=bytes(32),
            scopes="{read}",
        )
        for state in ("open", "finalizing", "ready", "rejected", "expired"):
            await self.dataset(f"ds_{state}", state=state)
        for name in ("ds_local", "ds_resumed"):
            await self.dataset(name)
        await self.dataset("ds_anna", "anna")
        self.insert(
            "webhooks",
            id="wh_1",
            tenant="local",
            url="https://example.org/",
            events="{job.succeeded}",
            secret="s",
        )
        for state in FINAL:
            await self.job(f"job_{state}", state)
        await self.job("job_given_up", "failed", checkpoint=True)
        await self.job("job_queued", "queued")
        dead = self._connection.execute(
            "INSERT INTO procrastinate_workers (last_heartbeat) VALUES (now() - interval '1 hour') RETURNING id"
        ).fetchone()[0]
        self.insert("slots", host="old", name="cpu0", worker_id=dead)
        token = {"run_token": uuid.uuid4(), "attempt": 1, "started_at": "now"}
        await self.job("job_resumed", "running", "ds_resumed", dead, checkpoint=True, **token)
        await self.job("job_stopping", "running", worker=dead, cancel_requested=True, **token)
        await self.job(
            "exp_done", "succeeded", kind="export", parent="job_succeeded", options={"formats": ["nvm"]}
        )
        await self.job("job_anna_done", "succeeded", "ds_anna", tenant="anna")
        await self.job("job_anna", "queued", "ds_anna", tenant="anna")
        await self.job("job_anna_held", "queued", "ds_anna", tenant="anna")
        export = {"kind": "export", "parent": "job_anna_done", "options": {"formats": ["kitti"]}}
        await self.job("exp_anna", "queued", "ds_anna", tenant="anna", **export)


@pytest.fixture
def settings(server: str, tmp_path: Path) -> Settings:
    """On a database that only the first release has migrated."""
    name = f"t{uuid.uuid4().hex[:12]}"
    url = f"{server}&options=-csearch_path%3D{name}"
    with psycopg.connect(server, autocommit=True) as connection:
        connection.execute(f"CREATE SCHEMA {name}".encode())
    with psycopg.connect(url) as connection:
        connection.execute(
            "CREATE TABLE schema_steps (name text PRIMARY KEY, applied_at timestamptz DEFAULT now())"
        )
        queue = job_queue.schema_steps()
        for step, sql in (queue[0], *(step for step in migrate._our_steps() if step[0] in FIRST)):
            connection.execute(sql.encode())
            connection.execute("INSERT INTO schema_steps (name) VALUES (%s)", (step,))
        for step, _ in queue[1:]:  # the first holds them
            connection.execute("INSERT INTO schema_steps (name) VALUES (%s)", (step,))
    program = EXPORTS.format(notes=str(tmp_path), counting=str(PROGRAM))
    command = (sys.executable, "-c", program)
    return quick_settings(tmp_path / "data", database_url=url, job_command=command, **SHORT_STALL)


async def ends(stores: Stores, journal: Path, *names: str) -> dict[str, str]:
    found = {}
    for name in names:
        job = Counting(stores, journal)
        job.id = name
        found[name] = (await job.until_final()).state
    return found


async def test_a_filled_database_of_the_first_release_goes_on_in_this_version(
    settings: Settings, slots: Slots, tmp_path: Path
):
    url = settings.require_database_url()
    with psycopg.connect(url, autocommit=True) as connection:
        await OldInstallation(settings, connection, tmp_path).fill()
        held = connection.execute("SELECT id FROM jobs WHERE held ORDER BY id").fetchall()
        assert held == [("job_anna_held",)]
        before = connection.execute("SELECT id, state, seq, artifacts FROM jobs ORDER BY id").fetchall()
        applied = migrate.migrate(url)
        assert [*FIRST, *applied] == [name for name, _ in migrate._our_steps()]
        assert migrate.migrate(url) == []
        after = connection.execute("SELECT id, state, seq, artifacts FROM jobs ORDER BY id").fetchall()
        assert after == before
        assert connection.execute("SELECT id FROM jobs WHERE held").fetchall() == [("job_anna_held",)]

    async with open_stores(settings) as stores:
        listed = {job.id: job.state for job in (await stores.jobs.list(limit=100)).items}
        assert listed == {row[0]: row[1] for row in before if row[0].startswith("job_")}
        assert {item.name for item in await stores.jobs.artifacts("job_succeeded")} == {
            "report.json",
            "poses.json",
        }
        assert (await stores.datasets.get("ds_finalizing")).state == "finalizing"
        assert (await stores.monitor.statistics()).jobs["succeeded"] == 3
        assert await stores.monitor.lacking() == {}
        slots.start(settings, "a")
        going_on = ("job_queued", "job_resumed", "job_stopping", "job_anna", "job_anna_held", "exp_anna")
        states = await ends(stores, tmp_path, *going_on)
        assert states == {**dict.fromkeys(going_on, "succeeded"), "job_stopping": "cancelled"}
        resumed = [json.loads(line) for line in (tmp_path / "ds_resumed").read_text().splitlines()]
        assert [start["from"] for start in resumed] == [5]
        new, _ = await stores.jobs.submit("ds_local", RefineOptions(preset="fast"))
        assert await ends(stores, tmp_path, new.id) == {new.id: "succeeded"}
        for name in (*going_on, new.id):
            numbers = [event.seq for event in (await stores.jobs.update(name)).events]
            assert numbers == list(range(1, len(numbers) + 1))
        # A checkpoint that the first version left in the row of an ended job.
        async with asyncio.timeout(60):
            while await stores.files.list("jobs/job_given_up/checkpoints"):
                await asyncio.sleep(0.1)
        (row,) = await stores.jobs._database.fetch(
            "SELECT count(*) AS n FROM jobs WHERE checkpoint IS NOT NULL"
        )
        assert row["n"] == 0


async def test_a_process_that_runs_when_columns_are_added_fails_for_a_moment_at_most(
    database_url: str, tmp_path: Path
):
    async with open_stores(quick_settings(tmp_path, database_url=database_url)) as stores:
        dataset = await stores.datasets.create("kitchen")
        for _ in range(10):  # after five, a connection has the statement prepared
            await stores.datasets.get(dataset.id)
        with psycopg.connect(database_url) as connection:
            connection.execute("ALTER TABLE datasets ADD COLUMN later int")
        with pytest.raises(Unavailable):
            await stores.datasets.get(dataset.id)
        assert await stores.datasets.get(dataset.id) == dataset
