"""A worker that is late, that lost an answer, or that slept with all the others."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from pathlib import Path

import pytest

from biresnerf.options.refine_options import RefineOptions
from tests.workers.conftest import claimed, ready_dataset, taken_by_somebody
from workers.database import job_queue
from workers.database.database import Database, open_database
from workers.database.job_queue import Entry
from workers.engine import Stores
from workers.jobs import claim as claims
from workers.jobs.claim import Fenced, claim_job
from workers.jobs.job_states import Requeue, finish
from workers.jobs.ledger import Ledger
from workers.queue.janitor import Janitor, release_worker
from workers.run.attempt import Attempt
from workers.settings.errors import Unavailable
from workers.settings.settings import Settings
from workers.store.file_places import LocalPlace
from workers.store.files import FileStore

pytestmark = pytest.mark.anyio


@pytest.fixture
async def database(database_url: str) -> AsyncIterator[Database]:
    async with open_database(database_url) as opened:
        yield opened


async def registered(database: Database) -> int:
    async with database.transaction() as connection:
        return await job_queue.register_worker(connection)


async def taken(database: Database, worker_id: int) -> Entry:
    async with database.transaction() as connection:
        entry = await job_queue.take(connection, worker_id)
    assert entry is not None
    return entry


async def queued(stores: Stores) -> str:
    dataset_id = await ready_dataset(stores, {"plan.json": b"{}"})
    job, _ = await stores.jobs.submit(dataset_id, RefineOptions(preset="fast"))
    return job.id


async def acknowledged(database: Database, worker_id: int, entry: Entry, again_in_s: float | None) -> bool:
    async with database.transaction() as connection:
        return await job_queue.acknowledge(connection, entry.id, worker_id, again_in_s=again_in_s)


@pytest.mark.parametrize("again_in_s", [None, 0])
async def test_a_late_receipt_leaves_a_row_that_another_worker_has_alone(
    stores: Stores, database: Database, again_in_s: float | None
):
    await queued(stores)
    frozen, other = await registered(database), await registered(database)
    entry = await taken(database, frozen)
    assert await acknowledged(database, frozen, entry, 0)
    assert await taken(database, other) == entry
    assert not await acknowledged(database, frozen, entry, again_in_s)
    (row,) = await database.fetch("SELECT state, worker_id FROM queue_entries")
    assert (row["state"], row["worker_id"]) == ("doing", other)
    assert await acknowledged(database, other, entry, None)
    (row,) = await database.fetch("SELECT state FROM queue_entries")
    assert row["state"] == "succeeded"


async def test_an_entry_whose_answer_was_lost_is_the_next_that_its_worker_takes(
    stores: Stores, database: Database
):
    first, _ = await queued(stores), await queued(stores)
    worker_id = await registered(database)
    entry = await taken(database, worker_id)  # and the connection broke after the commit
    assert await taken(database, worker_id) == entry
    assert entry.job_id == first


async def test_an_entry_that_is_put_back_for_later_is_not_offered_before(stores: Stores, database: Database):
    await queued(stores)
    worker_id = await registered(database)
    entry = await taken(database, worker_id)
    assert await acknowledged(database, worker_id, entry, 0.5)
    async with database.transaction() as connection:
        assert await job_queue.take(connection, worker_id) is None
    await asyncio.sleep(0.6)
    assert await taken(database, worker_id) == entry


async def test_a_job_whose_cancellation_was_answered_is_not_claimed_again(stores: Stores, database: Database):
    job_id = await queued(stores)
    await taken_by_somebody(database)
    assert await claimed(database, job_id) is not None
    assert (await stores.jobs.cancel(job_id)).state == "running"
    assert await claimed(database, job_id) is None
    job = await stores.jobs.get(job_id)
    assert (job.state, job.attempt) == ("cancelled", 1)


async def test_a_job_that_was_taken_back_is_not_claimed_by_who_had_it(stores: Stores, database: Database):
    """Taken for dead between taking and claiming, and awake again: the attempt would be lost, or run beside another."""
    job_id = await queued(stores)
    frozen, other = await registered(database), await registered(database)
    await taken(database, frozen)
    await release_worker(database, frozen, 60.0)
    assert await claim_job(database, job_id, frozen, max_attempts=3, stall_s=60.0) is None
    await taken(database, other)
    assert await claim_job(database, job_id, frozen, max_attempts=3, stall_s=60.0) is None
    job = await stores.jobs.get(job_id)
    assert (job.state, job.attempt) == ("queued", 0)
    assert await claim_job(database, job_id, other, max_attempts=3, stall_s=60.0) is not None


async def test_a_worker_that_is_lost_costs_a_job_nothing_before_it_starts_and_after_it_was_given_back(
    stores: Stores, database: Database
):
    job_id = await queued(stores)
    for _ in range(4):
        worker = await registered(database)
        await taken(database, worker)
        await release_worker(database, worker, 60.0)
    worker = await registered(database)
    await taken(database, worker)
    claim = await claim_job(database, job_id, worker, max_attempts=3, stall_s=60.0)
    assert claim is not None
    assert await Ledger(database, claim, 60.0).give_back(Requeue("requeued", {"why": "shutdown"}))
    await release_worker(database, worker, 60.0)
    (row,) = await database.fetch("SELECT state, attempt, crashes, setback FROM jobs")
    assert row == {"state": "queued", "attempt": 0, "crashes": 0, "setback": None}


async def test_a_janitor_and_a_worker_that_woke_up_end_jobs_of_one_tenant_at_once(
    stores: Stores, database: Database
):
    """Both make room for a job that is held: whoever had the tenant first waited for the other's job, without end."""
    await stores.tenants.set("local", max_running=2)
    cancelled, published, held = await queued(stores), await queued(stores), await queued(stores)
    for job_id in (cancelled, published):
        worker = await registered(database)
        await taken(database, worker)
        assert await claim_job(database, job_id, worker, max_attempts=3, stall_s=60.0) is not None
    await stores.jobs.cancel(cancelled)
    async with database.transaction() as connection:
        await connection.execute("SELECT 1 FROM jobs WHERE id = %s FOR UPDATE", (published,))
        janitor = asyncio.create_task(release_worker(database, None, 60.0))
        while not await database.fetch("SELECT 1 FROM pg_stat_activity WHERE wait_event_type = 'Lock'"):
            await asyncio.sleep(0.01)
        await finish(connection, published, "succeeded", None)
    await janitor
    rows = await database.fetch("SELECT id, state, held FROM jobs")
    assert {row["id"]: row["state"] for row in rows} == {
        cancelled: "cancelled",
        published: "succeeded",
        held: "queued",
    }
    assert not any(row["held"] for row in rows)


async def test_a_claim_whose_acknowledgement_was_lost_counts_once(
    stores: Stores, database: Database, monkeypatch: pytest.MonkeyPatch
):
    job_id = await queued(stores)
    claim, lost = claims._claim, []

    async def loses_the_first_answer(*arguments):
        answer = await claim(*arguments)
        if not lost:
            lost.append(answer)
            raise Unavailable("database_unavailable", "the connection broke after the commit")
        return answer

    monkeypatch.setattr(claims, "_claim", loses_the_first_answer)
    await taken_by_somebody(database)
    assert await claimed(database, job_id) == lost[0]
    assert (await stores.jobs.get(job_id)).attempt == 1
    assert [event.type for event in (await stores.jobs.update(job_id)).events] == ["queued", "started"]


async def test_a_machine_that_slept_takes_no_job_from_its_workers(
    stores: Stores, database: Database, settings: Settings, tmp_path: Path
):
    """To who looks at the clock afterwards everybody was silent for long; who goes on being silent is dead."""
    await queued(stores)
    await taken(database, await registered(database))
    quick = settings.model_copy(update={"stall_s": 0.8, "janitor_s": 0.1})
    janitor = Janitor(database, FileStore(LocalPlace(tmp_path / "files")), quick)

    async def status_after_a_round() -> str:
        await janitor._round()
        (row,) = await database.fetch("SELECT state FROM queue_entries")
        return str(row["state"])

    assert await status_after_a_round() == "doing"
    await asyncio.sleep(2.0)  # longer than the stall time, with every janitor and every beat asleep
    assert await status_after_a_round() == "doing"
    while await status_after_a_round() == "doing":
        await asyncio.sleep(0.1)


async def test_a_result_that_was_stored_in_vain_is_taken_away_again(
    stores: Stores, database: Database, settings: Settings, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    """By who was frozen while storing it: the job has ended since, and its trash was taken out."""
    job_id = await queued(stores)
    await taken_by_somebody(database)
    claim = await claimed(database, job_id)
    assert claim is not None
    files, folder = stores.files, tmp_path / "job"
    attempt = Attempt(database, files, settings, claim, folder, {})
    stored: list[str] = []

    async def finishes(_: Attempt) -> int:
        (folder / "output").mkdir(parents=True)
        (folder / "output" / "report.json").write_text("{}")
        return 0

    async def published(ledger: Ledger, artifacts, *rest) -> bool:
        stored.extend(artifact.key for artifact in artifacts)
        assert await claimed(database, claim.job_id) is not None  # another worker takes the job
        return await publish(ledger, artifacts, *rest)

    publish = Ledger.publish
    monkeypatch.setattr(Attempt, "_run_process", finishes)
    monkeypatch.setattr(Ledger, "publish", published)
    with pytest.raises(Fenced):
        await attempt.run()
    assert [key.split("/")[2:] for key in stored] == [["results", claim.name, "report.json"]]
    assert await files.list(f"jobs/{claim.job_id}") == []
