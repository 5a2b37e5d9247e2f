"""What `workers.database.job_queue` needs of Procrastinate. If this fails, read its changelog."""

from __future__ import annotations

import asyncio
import inspect
from pathlib import Path

import psycopg
import pytest
from procrastinate.connector import BaseAsyncConnector
from procrastinate.jobs import Job, Status
from procrastinate.manager import JobManager, get_channel_for_queues
from procrastinate.schema import SchemaManager

from tests.workers.conftest import ROOT, Slots
from workers.database import job_queue
from workers.database.database import Database, open_database
from workers.database.migrate import migrate
from workers.jobs.job_states import insert_job, queue_job, take_back
from workers.queue.janitor import Janitor, release_worker
from workers.settings.settings import Settings
from workers.store.file_places import LocalPlace
from workers.store.files import FileStore

METHODS = {
    "defer_job_async": {"job"},
    "fetch_job": {"queues", "worker_id"},
    "finish_job_by_id_async": {"job_id", "status", "delete_job"},
    "retry_job_by_id_async": {"job_id", "retry_at"},
    "cancel_job_by_id_async": {"job_id", "abort"},
    "get_stalled_jobs": {"queue", "seconds_since_heartbeat"},
    "register_worker": set(),
    "prune_stalled_workers": {"seconds_since_heartbeat"},
    "delete_old_jobs": {"nb_hours", "include_failed", "include_cancelled", "include_aborted"},
}


def test_one_module_knows_procrastinate():
    files = [
        file
        for folder in ("biresnerf", "workers", "service", "benchmarks")
        for suffix in ("*.py", "*.sql")
        for file in (ROOT / folder).rglob(suffix)
        if "procrastinate" in file.read_text().lower()
    ]
    assert [file.relative_to(ROOT).as_posix() for file in files] == ["workers/database/job_queue.py"]


@pytest.mark.parametrize("name", METHODS)
def test_the_manager_has_the_method_with_these_arguments(name: str):
    assert METHODS[name] <= set(inspect.signature(getattr(JobManager, name)).parameters)


@pytest.mark.parametrize(
    "name", ["execute_query_async", "execute_query_one_async", "execute_query_all_async"]
)
def test_a_connector_is_asked_by_these_methods(name: str):
    assert list(inspect.signature(getattr(BaseAsyncConnector, name)).parameters)[:2] == ["self", "query"]


def test_an_entry_has_these_fields():
    wanted = {"queue", "task_name", "priority", "lock", "queueing_lock", "task_kwargs", "scheduled_at", "id"}
    assert wanted <= {field.name for field in Job.__attrs_attrs__}
    assert {"SUCCEEDED", "ABORTED"} <= set(Status.__members__)


def test_the_columns_that_our_statements_name_exist(database_url: str):
    with psycopg.connect(database_url) as connection:
        connection.execute(
            "SELECT id, queue_name, args, status, worker_id, scheduled_at FROM procrastinate_jobs"
        )
        connection.execute("SELECT id, last_heartbeat FROM procrastinate_workers")
        states = connection.execute(
            "SELECT unnest(enum_range(NULL::procrastinate_job_status))::text"
        ).fetchall()
    assert {"todo", "doing", "succeeded", "failed", "cancelled", "aborted"} <= {state for (state,) in states}


def test_our_wake_up_uses_the_channel_workers_listen_on():
    assert sorted(get_channel_for_queues(job_queue.KINDS)) == sorted(job_queue.CHANNELS)


def test_the_notifications_say_what_they_are_about(database_url: str):
    with psycopg.connect(database_url, autocommit=True) as connection:
        for channel in job_queue.CHANNELS:
            connection.execute(f'LISTEN "{channel}"'.encode())
        connection.execute(
            "INSERT INTO procrastinate_jobs (id, queue_name, task_name) VALUES (7, %s, 'x')",
            (job_queue.EXPORTS,),
        )
        connection.execute("UPDATE procrastinate_jobs SET status = 'doing'")
        connection.execute("SELECT procrastinate_cancel_job_v1(7, true, false)")
        heard = [note.payload for note in connection.notifies(timeout=5, stop_after=2)]
    assert [job_queue.subject_of(payload) for payload in heard] == [job_queue.NEW_ENTRY, "7"]


def test_a_newer_version_brings_its_own_changes_of_the_schema(
    database_url: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    (tmp_path / "03.03.00_01_older.sql").write_text("SELECT an_error;")
    (tmp_path / "09.00.00_01_newer.sql").write_text(
        "ALTER TABLE procrastinate_jobs ADD COLUMN novel int, ALTER COLUMN args TYPE json;"
    )
    monkeypatch.setattr(SchemaManager, "get_migrations_path", staticmethod(lambda: str(tmp_path)))
    assert migrate(database_url) == ["000_procrastinate_09.00.00_01_newer"]
    assert migrate(database_url) == []
    with psycopg.connect(database_url) as connection:
        connection.execute("SELECT novel FROM procrastinate_jobs")
        connection.execute("SELECT id, job_id, state, worker_id FROM queue_entries")


@pytest.mark.anyio
async def test_two_janitors_at_once_release_a_job_once(database_url: str, tmp_path, settings: Settings):
    async with open_database(database_url) as one, open_database(database_url) as other:
        async with one.transaction() as connection:
            await connection.execute("INSERT INTO datasets (id, name, state) VALUES ('ds_1', 'x', 'ready')")
            job = {"id": "job_1", "dataset_id": "ds_1", "options": "{}", "fingerprint": "", "attempt": 1}
            await queue_job(connection, await insert_job(connection, {**job, "state": "running"}))
            entry = await job_queue.take(connection, await job_queue.register_worker(connection))
            assert entry is not None

        async def clean(database) -> None:
            async with database.transaction() as connection:
                await take_back(connection, entry.id, 60.0)

        await asyncio.gather(
            clean(one), clean(other), release_worker(one, None, 60.0), release_worker(other, None, 60.0)
        )
        (job,) = await one.fetch("SELECT state, attempt, seq FROM jobs")
        assert (job["state"], job["attempt"], job["seq"]) == ("queued", 1, 2)
        (row,) = await one.fetch("SELECT state FROM queue_entries")
        assert row["state"] == "todo"


@pytest.mark.anyio
async def test_a_job_that_the_queue_lost_is_queued_again(database_url: str, settings: Settings, tmp_path):
    async with open_database(database_url) as database:
        async with database.transaction() as connection:
            await connection.execute("INSERT INTO datasets (id, name, state) VALUES ('ds_1', 'x', 'ready')")
            await connection.execute(
                "INSERT INTO jobs (id, dataset_id, options, fingerprint, queue_id, updated_at)"
                " VALUES ('job_1', 'ds_1', '{}', '', 4711, now() - interval '1 hour')"
            )
        janitor = Janitor(database, FileStore(LocalPlace(tmp_path / "files")), settings)
        await janitor._round()
        (row,) = await database.fetch(
            "SELECT entry.state FROM jobs JOIN queue_entries AS entry ON entry.id = jobs.queue_id"
        )
        assert row["state"] == "todo"


async def registered(database: Database) -> set[int]:
    return {row["id"] for row in await database.fetch("SELECT id FROM queue_workers")}


@pytest.mark.anyio
async def test_a_worker_that_starts_does_not_tidy_a_silent_one_away(settings: Settings, slots: Slots):
    """After an outage everybody has been silent for long; the engine alone would prune the living."""
    patient = settings.model_copy(
        update={"stall_s": 3600.0}
    )  # longer than this server is up: no judgement yet
    async with open_database(settings.require_database_url()) as database:
        await database.fetch(
            "INSERT INTO procrastinate_workers (last_heartbeat) VALUES (now() - interval '1 day')"
        )
        (silent,) = await registered(database)
        slots.start(patient, "a")
        while len(now := await registered(database)) == 1 and silent in now:
            await asyncio.sleep(0.05)
        assert silent in now


@pytest.mark.anyio
async def test_a_silent_worker_is_tidied_away_in_the_end(settings: Settings, slots: Slots):
    async with open_database(settings.require_database_url()) as database:
        await database.fetch(
            "INSERT INTO procrastinate_workers (last_heartbeat) VALUES (now() - interval '1 day')"
        )
        (silent,) = await registered(database)
        slots.start(settings, "a")
        async with asyncio.timeout(120):
            while silent in await registered(database):
                await asyncio.sleep(0.05)
        assert await registered(database), "the live one stays"
