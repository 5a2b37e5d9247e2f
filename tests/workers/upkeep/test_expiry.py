"""Only what has expired is deleted: its files at once, records after a while, each thing once."""

from __future__ import annotations

import asyncio
import json
import time
from collections.abc import Awaitable, Callable
from pathlib import Path

import psycopg
import pytest

from biresnerf.options.refine_options import RefineOptions
from tests.workers.conftest import ready_dataset
from workers.database.database import open_database
from workers.engine import Stores
from workers.jobs.deadlines import end_overdue_jobs
from workers.jobs.quotas import submitting_for
from workers.settings.errors import Conflict, Expired, NotFound
from workers.settings.settings import Settings
from workers.store.trash import empty_trash
from workers.upkeep.dispatcher import dispatch
from workers.upkeep.expiry import Expiry

pytestmark = pytest.mark.anyio
PLAN = {"plan.json": json.dumps({"steps": 1, "step_s": 0, "journal": "/dev/null"}).encode()}
FINISHED = {"a.txt": b"abc", "b/c.txt": b"de"}


def aged(settings: Settings, table: str, row_id: str, days: float) -> None:
    """Pretend that this happened so many days ago."""
    columns = {"jobs": ("finished_at", "created_at"), "datasets": ("touched_at", "created_at")}[table]
    changes = ", ".join(f"{name} = {name} - make_interval(secs => {days * 86400})" for name in columns)
    with psycopg.connect(settings.require_database_url()) as connection:
        connection.execute(f"UPDATE {table} SET {changes} WHERE id = %s".encode(), (row_id,))


async def rounds(settings: Settings, stores: Stores, count: int = 1) -> None:
    async with open_database(settings.require_database_url(), connections=2) as database:
        for _ in range(count):
            await Expiry(database, settings).round()
            await empty_trash(database, stores.files)


async def finished_job(settings: Settings, stores: Stores, dataset_id: str | None = None, **more: str) -> str:
    """A job with a result in the store, made without a worker."""
    dataset_id = dataset_id or await ready_dataset(stores, PLAN)
    job, _ = await stores.jobs.submit(dataset_id, RefineOptions(preset="fast"), **more)
    artifacts = []
    for name, content in FINISHED.items():
        key = f"jobs/{job.id}/results/1-aa/{name}"
        stored = await stores.files.put(key, _once(content), limit_bytes=100)
        artifacts.append(
            {
                "name": name,
                "key": key,
                "size": stored.size,
                "sha256": stored.sha256,
                "media_type": "text/plain",
            }
        )
    with psycopg.connect(settings.require_database_url()) as connection:
        connection.execute(
            "UPDATE jobs SET state = 'succeeded', started_at = created_at, finished_at = clock_timestamp(),"
            " artifacts = %s WHERE id = %s",
            (json.dumps(artifacts), job.id),
        )
        connection.execute("SELECT add_job_event(%s, 'succeeded', '{}')", (job.id,))
    return job.id


async def _once(content: bytes):
    yield content


async def test_a_result_goes_when_its_time_is_over_and_the_log_proves_it(
    stores: Stores, settings: Settings, caplog: pytest.LogCaptureFixture
):
    caplog.set_level("INFO")
    old, young = [await finished_job(settings, stores) for _ in range(2)]
    aged(settings, "jobs", old, 7.01)
    aged(settings, "jobs", young, 6.99)
    await rounds(settings, stores)
    job = await stores.jobs.get(old)
    assert (job.state, job.final) == ("expired", True)
    assert await stores.files.list(f"jobs/{old}") == []
    with pytest.raises(Expired):
        await stores.jobs.artifacts(old)
    last = (await stores.jobs.update(old)).events[-1]
    assert (last.type, last.data) == ("files_expired", {"files": 2, "bytes": 5})
    assert f"deleted jobs/{old}: 2 files, 5 bytes; none is left" in caplog.text
    other = await stores.jobs.get(young)
    assert other.state == "succeeded"
    assert other.finished_at is not None
    assert other.expires_at is not None
    assert (other.expires_at - other.finished_at).days == 7
    assert len(await stores.jobs.artifacts(young)) == 2
    assert young not in caplog.text
    async for update in stores.jobs.subscribe(old):
        assert update is not None, "who follows it is told and let go"
    await stores.jobs.delete(old)


async def test_a_result_that_an_export_still_reads_stays_until_it_is_done(stores: Stores, settings: Settings):
    job_id = await finished_job(settings, stores)
    with psycopg.connect(settings.require_database_url()) as connection:
        connection.execute(
            "INSERT INTO jobs (id, dataset_id, kind, parent, options, fingerprint)"
            " SELECT 'job_export', dataset_id, 'export', id, '{}', 'x' FROM jobs WHERE id = %s",
            (job_id,),
        )
    aged(settings, "jobs", job_id, 8)
    await rounds(settings, stores)
    assert len(await stores.jobs.artifacts(job_id)) == 2
    with psycopg.connect(settings.require_database_url()) as connection:
        connection.execute("UPDATE jobs SET state = 'failed', finished_at = now() WHERE id = 'job_export'")
    await rounds(settings, stores)
    assert (await stores.jobs.get(job_id)).state == "expired"


async def test_a_dataset_goes_when_nothing_used_it_for_long(stores: Stores, settings: Settings):
    unused, queued, lately, fresh = [await ready_dataset(stores, PLAN) for _ in range(4)]
    job, _ = await stores.jobs.submit(queued, RefineOptions(preset="fast"))
    await finished_job(settings, stores, lately)
    for dataset_id in (unused, queued, lately):
        aged(settings, "datasets", dataset_id, 30)
    await rounds(settings, stores, 2)
    states = {item.id: item.state for item in (await stores.datasets.list()).items}
    assert states == {unused: "expired", queued: "ready", lately: "ready", fresh: "ready"}
    assert await stores.files.list(f"datasets/{unused}") == []
    with pytest.raises(Expired):
        await stores.datasets.files(unused)
    with pytest.raises(Conflict):
        await stores.jobs.submit(unused, RefineOptions(preset="fast"))
    assert (await stores.datasets.get(queued)).expires_at is None, "a job uses it"
    assert (await stores.datasets.get(lately)).expires_at is not None
    await stores.jobs.cancel(job.id)
    aged(settings, "jobs", job.id, 30)
    await rounds(settings, stores)
    assert (await stores.datasets.get(queued)).state == "expired"


async def test_later_rounds_of_a_dispatcher_date_what_changed(stores: Stores, settings: Settings):
    """The first looks at everything, the others at what was touched, submitted or ended since."""
    dataset_id = await ready_dataset(stores, PLAN)
    before = await finished_job(settings, stores, dataset_id)
    async with open_database(settings.require_database_url(), connections=2) as database:
        expiry = Expiry(database, settings)
        await expiry.round()
        aged(settings, "datasets", dataset_id, 1)
        waiting, _ = await stores.jobs.submit(dataset_id, RefineOptions(preset="fast"))
        ended, unused = await finished_job(settings, stores), await ready_dataset(stores, PLAN)
        assert (await stores.jobs.get(ended)).expires_at is None
        await expiry.round()
        assert (await stores.datasets.get(dataset_id)).expires_at is None, "a job uses it"
        assert (await stores.datasets.get(unused)).expires_at is not None
        for job_id in (before, ended):
            job = await stores.jobs.get(job_id)
            assert job.expires_at is not None
            assert (job.expires_at - job.finished_at).days == 7
        await stores.jobs.cancel(waiting.id)
        await expiry.round()
        assert (await stores.datasets.get(dataset_id)).expires_at is not None
        aged(settings, "jobs", ended, 8)
        await expiry.round()
        assert (await stores.jobs.get(ended)).state == "succeeded", "dated when it ended, a moment ago"
        expiry = Expiry(database, settings)
        await expiry.round()
        assert (await stores.jobs.get(ended)).state == "expired", "the first round looks at everything"


async def test_an_upload_that_goes_on_keeps_its_dataset(stores: Stores, settings: Settings):
    dataset = await stores.datasets.create("slow")
    aged(settings, "datasets", dataset.id, 30)
    upload = await stores.uploads.create(dataset.id, "archive", 1000)
    await rounds(settings, stores)
    assert (await stores.datasets.get(dataset.id)).state == "open"
    await stores.uploads.delete(upload.id)
    await rounds(settings, stores)
    assert (await stores.datasets.get(dataset.id)).state == "expired"


async def test_a_file_added_or_a_job_submitted_meanwhile_keeps_the_dataset(
    stores: Stores, settings: Settings
):
    """The date of the last round is old news: what counts is asked again under the dataset's lock."""
    used, touched = await ready_dataset(stores, PLAN), (await stores.datasets.create("open")).id
    with psycopg.connect(settings.require_database_url()) as connection:
        connection.execute("UPDATE datasets SET expires_at = now()")
    await stores.jobs.submit(used, RefineOptions(preset="fast"))
    await stores.datasets.add_file(touched, "a.txt", _once(b"a"))
    async with open_database(settings.require_database_url(), connections=2) as database:
        expiry = Expiry(database, settings)
        await expiry._expire_datasets()  # as if the dates had been set before
    assert (await stores.datasets.get(used)).state == "ready"
    assert (await stores.datasets.get(touched)).state == "open"


async def test_nothing_goes_where_things_are_kept_for_ever(stores: Stores, settings: Settings):
    job_id = await finished_job(settings, stores)
    dataset_id = (await stores.jobs.get(job_id)).dataset_id
    aged(settings, "jobs", job_id, 40)
    aged(settings, "datasets", dataset_id, 40)
    kept = {"keep_results_days": 0.0, "keep_datasets_days": 0.0, "keep_records_days": 0.0}
    await rounds(settings.model_copy(update=kept), stores)
    job, dataset = await stores.jobs.get(job_id), await stores.datasets.get(dataset_id)
    assert (job.state, job.expires_at, dataset.state, dataset.expires_at) == (
        "succeeded",
        None,
        "ready",
        None,
    )
    await rounds(settings, stores)
    assert (await stores.jobs.get(job_id)).state == "expired", "a shorter time holds for what is there"


async def test_an_idempotency_key_is_known_for_a_day_after_the_end(stores: Stores, settings: Settings):
    dataset_id = await ready_dataset(stores, PLAN)
    first = await finished_job(settings, stores, dataset_id, idempotency_key="k")
    await rounds(settings, stores)
    again, new = await stores.jobs.submit(dataset_id, RefineOptions(preset="fast"), idempotency_key="k")
    assert (again.id, new) == (first, False)
    aged(settings, "jobs", first, 1.01)
    await rounds(settings, stores)
    later, new = await stores.jobs.submit(dataset_id, RefineOptions(preset="fast"), idempotency_key="k")
    assert new
    assert later.id != first


async def test_records_of_what_expired_go_in_the_end(stores: Stores, settings: Settings):
    job_id = await finished_job(settings, stores)
    dataset_id = (await stores.jobs.get(job_id)).dataset_id
    aged(settings, "jobs", job_id, 90)
    aged(settings, "datasets", dataset_id, 90)
    await rounds(settings, stores)
    assert (await stores.jobs.get(job_id)).state == "expired"
    with psycopg.connect(settings.require_database_url()) as connection:
        for table in ("jobs", "datasets"):
            connection.execute(f"UPDATE {table} SET expires_at = expires_at - interval '8 days'".encode())
    await rounds(settings, stores)
    with pytest.raises(NotFound):
        await stores.jobs.get(job_id)
    with pytest.raises(NotFound):
        await stores.datasets.get(dataset_id)


async def test_the_record_of_a_job_that_expired_in_the_queue_goes_as_others_do(
    stores: Stores, settings: Settings
):
    dataset_id = await ready_dataset(stores, PLAN)
    job, _ = await stores.jobs.submit(dataset_id, RefineOptions(preset="fast"), expires_in_queue_s=1)
    with psycopg.connect(settings.require_database_url()) as connection:
        connection.execute("UPDATE jobs SET start_by = now() - interval '1 hour'")
    await stores.jobs._database.run(end_overdue_jobs, stall_s=2.0)
    await rounds(settings, stores)
    kept = await stores.jobs.get(job.id)
    assert kept.state == "expired"
    assert kept.expires_at is not None, "or its record would stay for ever"
    assert await stores.jobs.artifacts(job.id) == ()
    with psycopg.connect(settings.require_database_url()) as connection:
        connection.execute("UPDATE jobs SET expires_at = expires_at - interval '90 days'")
    await rounds(settings, stores)
    with pytest.raises(NotFound):
        await stores.jobs.get(job.id)


async def test_two_dispatchers_expire_each_thing_once(stores: Stores, settings: Settings, tmp_path: Path):
    dataset_id = await ready_dataset(stores, PLAN)
    jobs = [await finished_job(settings, stores, dataset_id) for _ in range(12)]
    for job_id in jobs:
        aged(settings, "jobs", job_id, 8)
    stop, busy = asyncio.Event(), settings.model_copy(update={"expiry_s": 0.05})
    working = [asyncio.create_task(dispatch(busy, stop)) for _ in range(2)]
    await until(lambda: all_expired(stores, jobs))
    stop.set()
    await asyncio.gather(*working)
    for job_id in jobs:
        assert [event.type for event in (await stores.jobs.update(job_id)).events].count("files_expired") == 1


async def all_expired(stores: Stores, jobs: list[str]) -> bool:
    return all([(await stores.jobs.get(job_id)).state == "expired" for job_id in jobs])


async def until(holds: Callable[[], Awaitable[bool]]) -> None:
    end = time.monotonic() + 20
    while not await holds():
        assert time.monotonic() < end, "waited too long"
        await asyncio.sleep(0.05)


async def test_submits_without_a_gap_keep_no_other_dataset_from_its_date_and_its_end(
    settings: Settings, stores: Stores
):
    busy, due, dated = [await ready_dataset(stores, PLAN) for _ in range(3)]
    await rounds(settings, stores)
    for dataset in (busy, due):
        aged(settings, "datasets", dataset, settings.keep_datasets_days + 1)
    with psycopg.connect(settings.require_database_url()) as connection:
        connection.execute("UPDATE datasets SET expires_at = now() WHERE id = ANY(%s)", ([busy, due],))
        connection.execute("UPDATE datasets SET expires_at = NULL WHERE id = %s", (dated,))
    going_on = asyncio.Event()

    async def submits() -> None:
        while going_on.is_set():
            await stores.jobs.submit(busy, RefineOptions(preset="fast"))

    url = settings.require_database_url()
    async with open_database(url, answer_s=10.0) as database, open_database(url) as submitting:
        # Submits of others that overlap: one has the lock at each moment.
        async with submitting.transaction() as first:
            await submitting_for(first, {busy}, None)
            going_on.set()
            more = [asyncio.create_task(submits()) for _ in range(3)]
            await Expiry(database, settings).round()
        await asyncio.sleep(0.2)
        expiry = Expiry(database, settings)
        for _ in range(3):
            await expiry.round()
        going_on.clear()
        await asyncio.gather(*more)
        assert (await stores.datasets.get(due)).state == "expired"
        assert (await stores.datasets.get(dated)).expires_at is not None
        await expiry.round()
        assert (await stores.datasets.get(busy)).state == "ready"
        assert (await stores.datasets.get(busy)).expires_at is None  # its jobs wait
