"""A job on a large set splits itself: its parts are jobs as all others, it waits in the database and joins them."""

from __future__ import annotations

import asyncio
import json
import os
import signal
from collections import Counter
from pathlib import Path

import anyio
import pytest

from biresnerf.options.refine_options import RefineOptions
from biresnerf.uncertainty import NOT_REFINED
from biresnerf.wire.jobs import JobView
from tests.workers.conftest import Counting, Slots, claimed, quick_settings, ready_dataset, taken_by_somebody
from workers.database import job_queue
from workers.engine import Stores
from workers.jobs.derived_jobs import DerivedJobs
from workers.jobs.job_expiry import expire_jobs
from workers.jobs.job_states import finish, request_cancel
from workers.jobs.ledger import Ledger
from workers.settings.errors import Conflict
from workers.settings.settings import Settings

pytestmark = [pytest.mark.anyio, pytest.mark.server]
STEPS = 6


async def parts_of(stores: Stores, job_id: str) -> tuple[JobView, ...]:
    return (await DerivedJobs(stores.jobs, stores.files).parts(job_id)).items


async def split(
    stores: Stores, tmp_path: Path, parts: int, **options: object
) -> tuple[JobView, tuple[JobView, ...]]:
    """A job that has split itself, without a worker that would run its parts."""
    counting = Counting(stores, tmp_path / "journal")
    await counting.submit(1, 0.0)
    database = stores.jobs._database
    entry = await taken_by_somebody(database)
    claim = await claimed(database, counting.id)
    assert claim is not None
    asked = [{"preset": "fast", "photos": [f"{n}.jpg"], **options} for n in range(parts)]
    assert await Ledger(database, claim, 60.0).split(asked)
    (held,) = await database.fetch("SELECT worker_id FROM queue_entries WHERE id = %s", entry.id)
    await database.run(job_queue.acknowledge, entry.id, held["worker_id"], again_in_s=None)
    return await stores.jobs.get(counting.id), await parts_of(stores, counting.id)


async def end(stores: Stores, job_id: str, state: str = "succeeded") -> None:
    async with stores.jobs._database.transaction() as connection:
        await connection.execute("UPDATE jobs SET state = 'running' WHERE id = %s", (job_id,))
        await finish(connection, job_id, state, None)


async def test_parts_run_as_other_jobs_and_the_whole_joins_their_results(
    stores: Stores, settings: Settings, counting: Counting, slots: Slots
) -> None:
    for name in ("a", "b"):
        slots.start(settings, name)
    await counting.submit(STEPS, 0.01, parts=3)
    done = await counting.until_final()
    assert (done.state, done.parts and done.parts.model_dump()) == (
        "succeeded",
        {"parts": 3, "over": 3, "failed": 0},
    )
    ran = Counter(str(start["photos"]) for start in counting.starts())
    assert ran == {"['0.jpg']": 1, "['1.jpg']": 1, "['2.jpg']": 1, "[]": 1}
    report = await counting.result()
    assert report["joined"] == {f"part-0{n}": ["report.json"] for n in (1, 2, 3)}
    parts = await parts_of(stores, done.id)
    assert [part.labels["name"] for part in parts] == [f"part {n} of 3" for n in (1, 2, 3)]
    assert {(part.state, part.parent, part.dataset_id) for part in parts} == {
        ("succeeded", done.id, done.dataset_id)
    }
    assert [job.id for job in (await stores.jobs.list()).items] == [done.id], (
        "parts are listed with the whole alone"
    )
    events = await counting.events()
    assert (events.count("split"), events.count("part_over"), events.count("started")) == (1, 3, 2)
    assert done.attempt == 1, "to split itself is no failed attempt"
    await counting.assert_one_result(STEPS)


async def test_what_is_missing_of_a_part_that_failed_is_told_to_the_whole(
    settings: Settings, counting: Counting, slots: Slots
) -> None:
    slots.start(settings, "a")
    await counting.submit(STEPS, 0.01, parts=3, bad_parts=["1.jpg"])
    done = await counting.until_final()
    assert (done.state, done.parts and done.parts.failed) == ("succeeded", 1)
    assert (await counting.result())["joined"] == {
        "part-01": ["report.json"], "part-02": [NOT_REFINED], "part-03": ["report.json"],
    }  # fmt: skip


async def test_a_killed_worker_costs_a_part_its_last_interval_and_the_whole_nothing(
    stores: Stores, database_url: str, tmp_path: Path, slots: Slots
) -> None:
    settings = quick_settings(tmp_path / "data", database_url=database_url, stall_s=1.5)
    first = slots.start(settings, "a")
    counting = Counting(stores, tmp_path / "journal")
    await counting.submit(12, 0.1, parts=2)
    await counting.until(lambda job: job.parts is not None)
    while len(counting.starts()) < 1 or (await parts_of(stores, counting.id))[0].progress.step < 6:
        await anyio.sleep(0.05)
    os.kill(first.pid, signal.SIGKILL)
    slots.start(settings, "b")
    done = await counting.until_final()
    assert done.state == "succeeded"
    of_the_killed = [start["from"] for start in counting.starts() if start["photos"] == ["0.jpg"]]
    assert of_the_killed[0] == 0
    assert of_the_killed[1] >= 5
    assert [len([s for s in counting.starts() if s["photos"] == photos]) for photos in (["1.jpg"], [])] == [
        1,
        1,
    ]


async def test_a_whole_is_not_offered_before_its_last_part_is_over(stores: Stores, tmp_path: Path) -> None:
    whole, parts = await split(stores, tmp_path, 3)
    assert (whole.state, whole.queue_position, whole.message) == ("queued", None, "0 of 3 parts are over")
    assert [part.queue_position for part in parts] == [1, 2, 3]
    database = stores.jobs._database
    taken = [(await taken_by_somebody(database)).job_id for _ in parts]
    assert taken == [part.id for part in parts]
    await end(stores, parts[0].id)
    await end(stores, parts[2].id, "failed")
    assert (await stores.jobs.get(whole.id)).message == "2 of 3 parts are over"
    with pytest.raises(AssertionError):
        await taken_by_somebody(database)
    await end(stores, parts[1].id)
    assert (await taken_by_somebody(database)).job_id == whole.id
    claim = await claimed(database, whole.id)
    assert claim is not None
    assert claim.attempt == 1


async def test_of_two_parts_that_end_at_once_one_offers_the_whole(stores: Stores, tmp_path: Path) -> None:
    for _ in range(5):
        whole, parts = await split(stores, tmp_path, 2)
        database = stores.jobs._database
        for _ in parts:
            await taken_by_somebody(database)
        await asyncio.gather(*(end(stores, part.id) for part in parts))
        assert (await taken_by_somebody(database)).job_id == whole.id
        await end(stores, whole.id)


async def test_parts_are_cancelled_with_their_whole(stores: Stores, tmp_path: Path) -> None:
    whole, parts = await split(stores, tmp_path, 3)
    await end(stores, parts[0].id)
    await taken_by_somebody(stores.jobs._database)
    await taken_by_somebody(stores.jobs._database)
    assert await claimed(stores.jobs._database, parts[1].id)
    with pytest.raises(Conflict):
        await stores.jobs.delete(whole.id)
    assert (await stores.jobs.cancel(whole.id)).state == "cancelled"
    after = await parts_of(stores, whole.id)
    assert [(part.state, part.cancel_requested) for part in after] == [
        ("succeeded", False), ("running", True), ("cancelled", True),
    ]  # fmt: skip


async def test_the_end_of_a_whole_is_its_last_event_whenever_its_parts_end(
    stores: Stores, tmp_path: Path
) -> None:
    whole, parts = await split(stores, tmp_path, 3)
    database = stores.jobs._database
    await taken_by_somebody(database)
    assert await claimed(database, parts[0].id)
    cancelled = await stores.jobs.cancel(whole.id)
    assert [part.state for part in await parts_of(stores, whole.id)] == ["running", "cancelled", "cancelled"]
    await end(stores, parts[0].id, "cancelled")
    assert [event.type for event in (await stores.jobs.update(whole.id)).events] == [
        "queued", "started", "split", "cancelled",
    ]  # fmt: skip
    assert (await stores.jobs.get(whole.id)).message == cancelled.message


async def test_a_job_that_was_cancelled_first_is_not_split(stores: Stores, counting: Counting) -> None:
    await counting.submit(1, 0.0)
    await taken_by_somebody(stores.jobs._database)
    claim = await claimed(stores.jobs._database, counting.id)
    assert claim is not None
    await stores.jobs.cancel(counting.id)
    assert not await Ledger(stores.jobs._database, claim, 60.0).split([{"photos": ["a.jpg"]}])
    assert (await stores.jobs.get(counting.id)).state == "cancelled"
    assert await parts_of(stores, counting.id) == ()


async def test_a_part_keeps_its_result_until_the_whole_has_joined_it(stores: Stores, tmp_path: Path) -> None:
    whole, parts = await split(stores, tmp_path, 2)
    database = stores.jobs._database

    async def expired() -> int:
        async with database.transaction() as connection:
            await connection.execute("UPDATE jobs SET expires_at = now() WHERE finished_at IS NOT NULL")
            return await expire_jobs(connection, 10)

    await end(stores, parts[0].id)
    assert await expired() == 0
    with pytest.raises(Conflict):
        await stores.jobs.delete(parts[0].id)
    await end(stores, parts[1].id)
    assert await expired() == 0
    await end(stores, whole.id)
    assert await expired() == 3


async def test_a_janitor_cancels_the_parts_of_a_job_that_was_stopped_at_its_deadline(
    stores: Stores, settings: Settings, tmp_path: Path, slots: Slots
) -> None:
    whole, parts = await split(stores, tmp_path, 2)
    for _ in parts:  # so that no slot runs them meanwhile
        await taken_by_somebody(stores.jobs._database)
    async with stores.jobs._database.transaction() as connection:
        await request_cancel(connection, whole.id, None, True, 60.0)  # as `end_overdue` does
    slots.start(settings, "a")
    with anyio.fail_after(30):
        while {part.state for part in await parts_of(stores, whole.id)} != {"cancelled"}:
            await anyio.sleep(0.1)


@pytest.mark.parametrize("limit", [1, 0])
async def test_a_waiting_whole_does_not_count_as_one_of_its_tenants_running_jobs(
    stores: Stores, settings: Settings, counting: Counting, slots: Slots, limit: int
) -> None:
    await stores.tenants.set("local", max_running=limit)
    slots.start(settings, "a")
    await counting.submit(2, 0.01, parts=2)
    assert (await counting.until_final()).state == "succeeded"


async def test_a_deleted_whole_takes_its_parts_along(stores: Stores, tmp_path: Path) -> None:
    whole, parts = await split(stores, tmp_path, 2)
    for part in parts:
        await end(stores, part.id)
    await end(stores, whole.id)
    await stores.jobs.delete(whole.id)
    rows = await stores.jobs._database.fetch("SELECT prefix FROM trash WHERE prefix LIKE 'jobs/%%'")
    assert {f"jobs/{job.id}" for job in (whole, *parts)} <= {row["prefix"] for row in rows}


async def test_a_set_is_split_only_above_what_the_job_or_the_operator_says(
    stores: Stores, settings: Settings, tmp_path: Path
) -> None:
    from workers.run.staging import stage_job

    async def ordered(part_photos: int | None, changed: Settings) -> object:
        dataset_id = await ready_dataset(stores, {"plan.json": b"{}"})
        job, _ = await stores.jobs.submit(dataset_id, RefineOptions(preset="fast"), part_photos=part_photos)
        await taken_by_somebody(stores.jobs._database)
        claim = await claimed(stores.jobs._database, job.id)
        assert claim is not None
        await stage_job(stores.jobs._database, stores.files, changed, claim, tmp_path / "job")
        order = json.loads((tmp_path / "job/job.json").read_text())
        await end(stores, job.id)
        return order.get("split")

    never = settings.model_copy(update={"split_above": 0})
    assert await ordered(None, settings) == {"above": 1000, "most": 400}
    assert await ordered(50, settings) == {"above": 50, "most": 50}
    assert await ordered(50, never) == {"above": 50, "most": 50}
    assert await ordered(None, never) is None
