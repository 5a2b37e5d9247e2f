"""The names of the queue engine that we lean on beyond its documented surface. Red here: read its changelog."""

from __future__ import annotations

import asyncio
import inspect

import procrastinate
import psycopg
import pytest
from procrastinate import App, JobContext, PsycopgConnector, RetryStrategy
from procrastinate.job_context import AbortReason
from procrastinate.manager import get_channel_for_queues
from procrastinate.worker import Worker

from tests.workers.conftest import Slots
from workers.database.database import QUEUE, Database, open_database
from workers.queue.fenced_worker import FencedWorker
from workers.queue.janitor import Janitor, release, release_worker
from workers.settings.settings import Settings
from workers.store.file_places import LocalPlace
from workers.store.files import FileStore

FUNCTIONS = {
    "procrastinate_cancel_job_v1": "bigint, boolean, boolean",
    "procrastinate_finish_job_v1": "bigint, procrastinate_job_status, boolean",
    "procrastinate_retry_job_v2": "bigint, timestamp with time zone, integer, character varying, character varying",
}


def test_the_engine_is_the_minor_version_that_was_tested():
    assert procrastinate.__version__.startswith("3.10.")


@pytest.mark.parametrize("name", FUNCTIONS)
def test_the_sql_function_exists_with_these_arguments(database_url: str, name: str):
    with psycopg.connect(database_url) as connection:
        row = connection.execute("SELECT to_regprocedure(%s)", (f"{name}({FUNCTIONS[name]})",)).fetchone()
    assert row is not None
    assert row[0] is not None


def test_the_columns_the_janitor_reads_exist(database_url: str):
    with psycopg.connect(database_url) as connection:
        connection.execute("SELECT id, queue_name, status, worker_id FROM procrastinate_jobs")
        connection.execute("SELECT id, last_heartbeat FROM procrastinate_workers")
        states = connection.execute(
            "SELECT unnest(enum_range(NULL::procrastinate_job_status))::text"
        ).fetchall()
    assert {"todo", "doing", "succeeded", "failed", "cancelled", "aborted"} <= {state for (state,) in states}


def test_the_worker_takes_our_arguments_and_shows_its_id():
    wanted = {
        *("queues", "name", "concurrency", "shutdown_graceful_timeout", "update_heartbeat_interval"),
        *("stalled_worker_timeout", "fetch_job_polling_interval", "abort_job_polling_interval"),
    }
    assert wanted <= set(inspect.signature(Worker.__init__).parameters)
    assert Worker(App(connector=PsycopgConnector())).worker_id is None


def test_the_receipt_that_is_fenced_is_the_one_the_worker_gives():
    given = list(inspect.signature(Worker._persist_job_status).parameters)
    assert given == ["self", "job", "status", "retry_decision", "context", "job_result"]
    assert list(inspect.signature(FencedWorker._persist_job_status).parameters) == given
    assert Worker(App(connector=PsycopgConnector()))._job_ids_to_abort == {}


def test_the_context_tells_a_users_wish_from_a_shutdown():
    assert {"USER_REQUEST", "SHUTDOWN"} <= set(AbortReason.__members__)
    assert "abort_reason" in {field.name for field in JobContext.__attrs_attrs__}


def test_a_retry_strategy_without_a_maximum_retries_for_ever():
    job = procrastinate.jobs.Job(
        id=1, queue="q", lock=None, queueing_lock=None, task_name="t", attempts=10_000, task_kwargs={}
    )
    assert RetryStrategy(wait=0).get_retry_decision(exception=RuntimeError(), job=job) is not None


def test_our_wake_up_uses_the_channel_workers_listen_on():
    assert list(get_channel_for_queues([QUEUE])) == [f"procrastinate_queue_v1#{QUEUE}"]


@pytest.mark.anyio
async def test_two_janitors_at_once_release_a_job_once(database_url: str, tmp_path, settings: Settings):
    async with open_database(database_url) as one, open_database(database_url) as other:
        async with one.transaction() as connection:
            await connection.execute("INSERT INTO datasets (id, name, state) VALUES ('ds_1', 'x', 'ready')")
            await connection.execute(
                "INSERT INTO jobs (id, dataset_id, options, fingerprint, state, attempt)"
                " VALUES ('job_1', 'ds_1', '{}', '', 'running', 1)"
            )
            queue_id = await one.enqueue(connection, "job_1")
            await connection.execute("UPDATE jobs SET queue_id = %s", (queue_id,))
            await connection.execute("UPDATE procrastinate_jobs SET status = 'doing'")

        async def clean(database) -> None:
            async with database.transaction() as connection:
                await release(connection, queue_id, "worker_lost")

        await asyncio.gather(clean(one), clean(other), release_worker(one, None), release_worker(other, None))
        (job,) = await one.fetch("SELECT state, attempt, seq FROM jobs")
        assert (job["state"], job["attempt"], job["seq"]) == ("queued", 1, 1)
        (row,) = await one.fetch("SELECT status FROM procrastinate_jobs")
        assert row["status"] == "todo"


@pytest.mark.anyio
async def test_a_job_that_the_queue_lost_is_queued_again(database_url: str, settings: Settings, tmp_path):
    async with open_database(database_url) as database:
        async with database.transaction() as connection:
            await connection.execute("INSERT INTO datasets (id, name, state) VALUES ('ds_1', 'x', 'ready')")
            await connection.execute(
                "INSERT INTO jobs (id, dataset_id, options, fingerprint, queue_id, updated_at)"
                " VALUES ('job_1', 'ds_1', '{}', '', 4711, now() - interval '1 hour')"
            )
        janitor = Janitor(database, FileStore(LocalPlace(tmp_path / "files")), settings, lambda: None, ())
        await janitor._round()
        (row,) = await database.fetch(
            "SELECT queue.status FROM jobs JOIN procrastinate_jobs AS queue ON queue.id = jobs.queue_id"
        )
        assert row["status"] == "todo"


async def registered(database: Database) -> set[int]:
    return {row["id"] for row in await database.fetch("SELECT id FROM procrastinate_workers")}


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
        while silent in await registered(database):
            await asyncio.sleep(0.05)
