"""What has not started in time does not start, and what runs too long ends with its best poses. Real processes."""

from __future__ import annotations

import asyncio
from datetime import UTC, datetime, timedelta
from functools import partial

import pytest

from biresnerf.errors import InputError
from biresnerf.options.refine_options import RefineOptions
from biresnerf.wire.jobs import JobView
from biresnerf.wire.webhooks import ALL_EVENTS
from tests.workers.conftest import Counting, Slots, claimed, taken_by_somebody
from tests.workers.run.test_attempt import content, named, until_previewed
from workers.database import job_queue
from workers.engine import Stores
from workers.jobs.deadlines import end_overdue_jobs
from workers.jobs.derived_jobs import DerivedJobs
from workers.jobs.job_states import Requeue
from workers.jobs.ledger import Ledger
from workers.queue.janitor import release_worker
from workers.settings.errors import Conflict, LimitReached
from workers.settings.settings import Settings

pytestmark = pytest.mark.anyio
FAST = RefineOptions(preset="fast")
STALL_S = 2.0


def in_an_hour() -> datetime:
    return datetime.now(UTC) + timedelta(hours=1)


async def an_hour_passes(stores: Stores) -> None:
    """For the dates of all jobs: by the clock of the database, which alone counts."""
    await stores.jobs._database.fetch(
        "UPDATE jobs SET start_by = start_by - interval '61 minutes',"
        " deadline_at = deadline_at - interval '61 minutes' RETURNING id"
    )


def stopped_at_its_deadline(job: JobView) -> bool:
    return job.state == "cancelled" and job.error is not None and job.error.code == "deadline_passed"


async def test_a_job_that_waits_too_long_expires_and_never_runs(
    counting: Counting, settings: Settings, slots: Slots
):
    slots.start(settings, "a")
    running = await counting.submit(1000, 0.05)
    await counting.until(lambda job: job.state == "running")
    await counting.submit(3, 0.01, details={"expires_in_queue_s": 1})
    asked = await counting.stores.jobs.get(counting.id)
    assert asked.start_by is not None
    assert timedelta(seconds=0.9) < asked.start_by - asked.created_at < timedelta(seconds=1.1)
    job = await counting.until_final()
    assert (job.state, job.started_at, job.partial) == ("expired", None, False)
    assert job.error is not None
    assert job.error.code == "deadline_passed"
    assert f"{asked.start_by:%H:%M:%S}" in job.error.detail
    assert job.finished_at is not None
    assert job.finished_at >= asked.start_by
    assert await counting.events() == ["queued", "expired"]
    expired, counting.id = counting.id, running
    await counting.stores.jobs.cancel(running)
    await counting.until_final()
    await counting.submit(3, 0.01)
    assert (await counting.until_final()).state == "succeeded", "the queue goes on without it"
    assert (await counting.stores.jobs.get(expired)).state == "expired"
    assert len(counting.starts()) == 2


@pytest.mark.parametrize("fault", [None, "deaf"])
async def test_a_running_job_ends_at_its_deadline_with_its_best_poses(
    counting: Counting, settings: Settings, slots: Slots, fault: str | None
):
    """From the process itself, or its last preview where it has to be killed."""
    slots.start(settings.model_copy(update={"cancel_grace_s": 0.5}), "a")
    faults = {fault: True} if fault else {}
    await counting.submit(1000, 0.05, details={"deadline_at": in_an_hour()}, preview_every=5, **faults)
    await until_previewed(counting, 5)
    await an_hour_passes(counting.stores)
    job = await counting.until_final(timeout_s=20)
    assert stopped_at_its_deadline(job)
    assert job.partial
    left = await named(counting)
    assert set(left) == {"log.txt", "poses.json", "report.json"}
    assert (await content(counting.stores, left["report.json"]))["state"] == "partial"
    assert ("previews" in left["poses.json"].key) == (fault is not None)
    events = (await counting.stores.jobs.update(counting.id)).events
    (asked,) = [event for event in events if event.type == "cancel_requested"]
    assert asked.data == {"code": "deadline_passed"}
    assert events[-1].data | {"detail": ""} == {"code": "deadline_passed", "partial": True, "detail": ""}


async def test_a_job_that_has_started_does_not_expire(counting: Counting, settings: Settings, slots: Slots):
    """Its time in the queue counts no more, even where it waits there again for a worker in the place of a lost one."""
    first = slots.start(settings, "a")
    await counting.submit(100, 0.05, details={"expires_in_queue_s": 3600})
    await counting.until(lambda job: job.progress.step >= 6)
    await an_hour_passes(counting.stores)
    await asyncio.sleep(3 * settings.janitor_s)
    assert (await counting.stores.jobs.get(counting.id)).state == "running"
    first.kill()
    first.wait()
    slots.start(settings, "a")
    job = await counting.until_final()
    assert (job.state, job.attempt) == ("succeeded", 2)
    assert int(counting.starts()[1]["from"]) >= 5, "and it goes on from its checkpoint"


@pytest.mark.parametrize("previewed", [True, False])
async def test_a_job_that_lost_its_worker_is_not_resumed_beyond_its_deadline(
    counting: Counting, settings: Settings, slots: Slots, previewed: bool
):
    first = slots.start(settings, "a")
    often = {"preview_every": 5} if previewed else {}
    await counting.submit(1000, 0.05, details={"deadline_at": in_an_hour()}, **often)
    await (until_previewed(counting, 5) if previewed else counting.until(lambda job: job.progress.step > 5))
    first.kill()
    first.wait()
    await an_hour_passes(counting.stores)
    slots.start(settings, "a")
    job = await counting.until_final()
    assert stopped_at_its_deadline(job)
    assert job.partial == previewed
    assert set(await named(counting)) == ({"poses.json", "report.json"} if previewed else set())
    assert len(counting.starts()) == 1


async def _begun(stores: Stores, dataset_id: str) -> str:
    """A job that was started and given back."""
    job, _ = await stores.jobs.submit(dataset_id, FAST, deadline_at=in_an_hour())
    database = stores.jobs._database
    entry = await taken_by_somebody(database)
    claim = await claimed(database, job.id)
    assert claim is not None
    await Ledger(database, claim, STALL_S).give_back(Requeue("requeued", {"why": "shutdown"}))
    await database.run(partial(job_queue.put_back, entry_id=entry.id))
    return job.id


@pytest.mark.parametrize("way", ["janitor", "claim"])
@pytest.mark.parametrize("begun", [True, False])
async def test_whoever_sees_it_first_ends_an_overdue_job_once(
    stores: Stores, dataset_id: str, way: str, begun: bool
):
    database = stores.jobs._database
    if begun:
        job_id = await _begun(stores, dataset_id)
    else:
        job_id = (await stores.jobs.submit(dataset_id, FAST, deadline_at=in_an_hour()))[0].id
    await database.run(partial(end_overdue_jobs, stall_s=STALL_S))
    assert (await stores.jobs.get(job_id)).state == "queued", "its time has not come"
    await an_hour_passes(stores)
    if way == "claim":
        await taken_by_somebody(database)
        assert await claimed(database, job_id) is None
    await asyncio.gather(
        *(database.run(partial(end_overdue_jobs, stall_s=STALL_S)) for _ in range(3)),
        release_worker(database, None, STALL_S),
    )
    job = await stores.jobs.get(job_id)
    assert job.state == ("cancelled" if begun else "expired")
    assert job.error is not None
    assert job.error.code == "deadline_passed"
    ends = [event.type for event in (await stores.jobs.update(job_id)).events if event.type == job.state]
    assert ends == [job.state]
    (entry,) = await database.fetch("SELECT state FROM queue_entries WHERE job_id = %s", job_id)
    assert entry["state"] not in ("todo", "doing")


async def test_a_claim_of_an_overdue_job_whose_row_still_says_running_ends_it(
    stores: Stores, dataset_id: str
):
    """A worker failed so badly that it gave back the queue's entry alone."""
    database = stores.jobs._database
    job, _ = await stores.jobs.submit(dataset_id, FAST, deadline_at=in_an_hour())
    await taken_by_somebody(database)
    assert await claimed(database, job.id) is not None
    await an_hour_passes(stores)
    assert await claimed(database, job.id) is None
    assert stopped_at_its_deadline(await stores.jobs.get(job.id))


async def test_a_job_that_expired_in_the_queue_is_told_counted_and_makes_room(
    stores: Stores, dataset_id: str
):
    hook, _ = await stores.webhooks.create("local", "https://hooks.example.org/in", ALL_EVENTS)
    await stores.tenants.set("local", max_queued=1, max_running=1)
    job, _ = await stores.jobs.submit(dataset_id, FAST, expires_in_queue_s=3600)
    with pytest.raises(LimitReached):
        await stores.jobs.submit(dataset_id, FAST)
    await an_hour_passes(stores)
    await stores.jobs._database.run(partial(end_overdue_jobs, stall_s=STALL_S))
    other, _ = await stores.jobs.submit(dataset_id, FAST)
    assert (await stores.jobs.get(other.id)).queue_position == 1
    (held,) = await stores.jobs._database.fetch("SELECT held FROM jobs WHERE id = %s", other.id)
    assert not held["held"], "the limit of jobs at a time has room as well"
    told = [item for item in (await stores.webhooks.deliveries(hook.id)).items if item.event == "job.expired"]
    assert len(told) == 1
    assert '"deadline_passed"' in told[0].body
    assert [item.id for item in (await stores.jobs.list(state="expired")).items] == [job.id]
    assert (await stores.jobs.counts())["expired"] == 1
    now = await stores.monitor.statistics()
    assert now.jobs["expired"] == 1
    counted = {(tally["name"], tally["label"]): tally["count"] for tally in now.tallies}
    assert (counted["job_events", "expired"], counted["job_seconds", "expired"]) == (1, 1)
    await stores.jobs.delete(job.id)


async def test_no_job_is_made_from_one_that_missed_its_deadline(stores: Stores, dataset_id: str):
    job, _ = await stores.jobs.submit(dataset_id, FAST, expires_in_queue_s=3600)
    await an_hour_passes(stores)
    await stores.jobs._database.run(partial(end_overdue_jobs, stall_s=STALL_S))
    derived = DerivedJobs(stores.jobs, stores.files)
    for making in (
        derived.fork(job.id, {"warmup_steps": 5}),
        derived.export(job.id, ["kitti"]),
        stores.jobs.submit(dataset_id, FAST, fixed_from=job.id),
    ):
        with pytest.raises(Conflict):
            await making


async def test_a_deadline_is_refused_where_it_has_passed_or_is_too_far(stores: Stores, dataset_id: str):
    now = datetime.now(UTC)
    for ahead, word in ((timedelta(seconds=-1), "has passed"), (timedelta(days=30, seconds=60), "30 days")):
        with pytest.raises(InputError, match=word) as told:
            await stores.jobs.submit(dataset_id, FAST, deadline_at=now + ahead)
        assert (told.value.code, told.value.where) == ("deadline_refused", "deadline_at")
    assert (await stores.jobs.list()).items == ()


async def test_a_request_repeated_after_its_deadline_is_the_same_job(stores: Stores, dataset_id: str):
    soon = datetime.now(UTC) + timedelta(seconds=1)
    both = {"idempotency_key": "k", "expires_in_queue_s": 60, "deadline_at": soon}
    first, _ = await stores.jobs.submit(dataset_id, FAST, **both)
    assert (first.start_by, first.deadline_at) == (soon, soon), "the earlier of the two"
    await asyncio.sleep(1.1)
    again, new = await stores.jobs.submit(dataset_id, FAST, **both)
    assert (again.id, new) == (first.id, False)
    for other in ({"expires_in_queue_s": 61}, {"deadline_at": None}):
        with pytest.raises(Conflict) as told:
            await stores.jobs.submit(dataset_id, FAST, **{**both, **other})
        assert told.value.code == "idempotency_key_reused"
