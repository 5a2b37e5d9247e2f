"""The job record without any worker: submitting, listing, cancelling."""

from __future__ import annotations

import asyncio

import psycopg
import pytest

from biresnerf.errors import InputError
from biresnerf.options.refine_options import RefineOptions
from tests.workers.conftest import Slots, ready_dataset
from workers.database import job_queue
from workers.database.database import Database, open_database
from workers.engine import Stores, open_stores
from workers.settings.errors import Conflict, LimitReached, NotFound, SetupError, Unavailable
from workers.settings.settings import Settings

pytestmark = pytest.mark.anyio
FAST = RefineOptions(preset="fast")


async def rows(settings: Settings, table: str) -> int:
    async with await psycopg.AsyncConnection.connect(settings.require_database_url()) as connection:
        row = await (await connection.execute(f"SELECT count(*) FROM {table}".encode())).fetchone()
        return row[0]


async def test_a_submitted_job_is_queued_with_the_options_asked_for(stores: Stores, dataset_id: str):
    job, new = await stores.jobs.submit(dataset_id, FAST, labels={"scene": "fox"})
    assert new
    assert (job.state, job.queue_position, job.attempt, job.labels) == ("queued", 1, 0, {"scene": "fox"})
    assert (job.options, job.resolved_options) == ({"preset": "fast"}, None)
    assert job.id.startswith("job_")
    assert await stores.jobs.get(job.id) == job


async def test_a_failing_submit_leaves_neither_job_nor_queue_row(
    stores: Stores, dataset_id: str, settings: Settings, monkeypatch: pytest.MonkeyPatch
):
    async def fails_after_the_queue_row(*arguments, **options):
        await real(*arguments, **options)
        raise RuntimeError("the process dies here")

    real = job_queue.enqueue
    monkeypatch.setattr(job_queue, "enqueue", fails_after_the_queue_row)
    with pytest.raises(RuntimeError):
        await stores.jobs.submit(dataset_id, FAST)
    assert [await rows(settings, table) for table in ("jobs", "queue_entries", "job_events")] == [
        0,
        0,
        0,
    ]


async def test_job_and_queue_row_are_written_together(stores: Stores, dataset_id: str, settings: Settings):
    await stores.jobs.submit(dataset_id, FAST)
    assert [await rows(settings, table) for table in ("jobs", "queue_entries", "job_events")] == [
        1,
        1,
        1,
    ]


async def test_the_same_key_gives_the_same_job_and_another_request_a_conflict(
    stores: Stores, dataset_id: str
):
    first, _ = await stores.jobs.submit(dataset_id, FAST, idempotency_key="k")
    again, new = await stores.jobs.submit(dataset_id, FAST, idempotency_key="k")
    assert (again.id, new) == (first.id, False)
    with pytest.raises(Conflict) as caught:
        await stores.jobs.submit(dataset_id, RefineOptions(preset="quality"), idempotency_key="k")
    assert caught.value.code == "idempotency_key_reused"


async def test_the_same_key_at_the_same_time_gives_one_job(stores: Stores, dataset_id: str):
    answers = await asyncio.gather(
        *(stores.jobs.submit(dataset_id, FAST, idempotency_key="k") for _ in range(6))
    )
    assert len({job.id for job, _ in answers}) == 1
    assert [new for _, new in answers].count(True) == 1


async def test_a_full_queue_takes_no_more(settings: Settings):
    async with open_stores(settings.model_copy(update={"max_queued": 2})) as stores:
        dataset_id = await ready_dataset(stores, {"plan.json": b"{}"})
        answers = await asyncio.gather(
            *(stores.jobs.submit(dataset_id, FAST) for _ in range(4)), return_exceptions=True
        )
        refused = [answer for answer in answers if isinstance(answer, LimitReached)]
        assert [error.code for error in refused] == ["queue_full"] * 2


async def test_a_dataset_that_is_missing_or_not_ready_is_refused(stores: Stores):
    with pytest.raises(NotFound):
        await stores.jobs.submit("ds_none", FAST)
    dataset = await stores.datasets.create("empty")
    with pytest.raises(Conflict) as caught:
        await stores.jobs.submit(dataset.id, FAST)
    assert caught.value.code == "dataset_not_ready"


async def test_lists_are_newest_first_and_pages_join(stores: Stores, dataset_id: str):
    made = [(await stores.jobs.submit(dataset_id, FAST, labels={"n": str(n % 2)}))[0].id for n in range(5)]
    seen, cursor = [], None
    while True:
        page = await stores.jobs.list(limit=2, cursor=cursor)
        seen += [job.id for job in page.items]
        cursor = page.next_cursor
        if cursor is None:
            break
    assert seen == made[::-1]
    odd = await stores.jobs.list(label=("n", "1"))
    assert [job.id for job in odd.items] == [made[3], made[1]]
    assert (await stores.jobs.list(state="running")).items == ()
    assert [(await stores.jobs.get(job_id)).queue_position for job_id in made] == [1, 2, 3, 4, 5]
    await stores.jobs.cancel(made[1])
    listed = {job.id: job.queue_position for job in (await stores.jobs.list()).items}
    assert listed == {job_id: (await stores.jobs.get(job_id)).queue_position for job_id in made}
    assert sorted(place for place in listed.values() if place) == [1, 2, 3, 4]


@pytest.mark.parametrize("cursor", ["nonsense", "W10", "WyJhIl0", "WyJ4IiwieSJd", "\u00e9"])
async def test_a_foreign_cursor_is_refused(stores: Stores, cursor: str):
    with pytest.raises(InputError) as caught:
        await stores.jobs.list(cursor=cursor)
    assert caught.value.code == "bad_cursor"


async def test_a_queued_job_is_cancelled_at_once_and_never_runs(
    stores: Stores, dataset_id: str, settings: Settings, slots: Slots
):
    job, _ = await stores.jobs.submit(dataset_id, FAST)
    cancelled = await stores.jobs.cancel(job.id)
    assert cancelled.state == "cancelled"
    assert (await stores.jobs.cancel(job.id)).revision == cancelled.revision, "a second time changes nothing"
    slots.start(settings, "a")
    await asyncio.sleep(1.5)
    assert [event.type for event in (await stores.jobs.update(job.id)).events] == ["queued", "cancelled"]


async def test_only_final_jobs_are_deleted_and_their_files_follow(
    stores: Stores, dataset_id: str, settings: Settings, slots: Slots
):
    job, _ = await stores.jobs.submit(dataset_id, FAST)
    with pytest.raises(Conflict):
        await stores.jobs.delete(job.id)
    await stores.jobs.cancel(job.id)
    (settings.files_dir / "jobs" / job.id / "results").mkdir(parents=True)
    (settings.files_dir / "jobs" / job.id / "results" / "x").write_bytes(b"x")
    await stores.jobs.delete(job.id)
    with pytest.raises(NotFound):
        await stores.jobs.get(job.id)
    slots.start(settings, "a")
    for _ in range(600):
        if not (settings.files_dir / "jobs" / job.id).exists():
            return
        await asyncio.sleep(0.05)
    raise AssertionError("the janitor did not delete the files")


async def test_a_database_that_is_away_is_unavailable_and_not_a_crash(settings: Settings, tmp_path):
    with pytest.raises(SetupError) as caught:
        async with open_database(
            f"postgresql://postgres@/none?host={tmp_path}", patience_s=0.2, opening_s=0.5
        ):
            pass
    assert caught.value.code == "database_unreachable"
    async with open_database(settings.require_database_url(), patience_s=0.3) as database:
        await database.pool.close()
        with pytest.raises(Unavailable):
            await database.fetch("SELECT 1")


async def test_a_transaction_that_falls_silent_gives_its_locks_back(settings: Settings):
    url = settings.require_database_url()

    async def fall_silent(silent: Database, other: Database) -> None:
        async with silent.transaction() as connection:
            await connection.execute("SELECT pg_advisory_xact_lock(1)")
            async with asyncio.timeout(10):
                await other.fetch("SELECT pg_advisory_xact_lock(1)")
            await connection.execute("SELECT 1")

    async with open_database(url, silence_s=0.3) as silent, open_database(url) as other:
        with pytest.raises(Unavailable):
            await fall_silent(silent, other)
        assert await silent.fetch("SELECT 1 AS one") == [{"one": 1}], "a new transaction is possible"
