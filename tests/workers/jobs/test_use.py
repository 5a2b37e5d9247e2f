"""What attempts used is added up once, however they end, and stays when their jobs are deleted."""

from __future__ import annotations

import asyncio
import sys
from collections.abc import Awaitable, Callable
from datetime import UTC, date, datetime, timedelta
from typing import Any

import pytest

from biresnerf.options.refine_options import RefineOptions
from biresnerf.wire.problems import JobError
from tests.workers.conftest import (
    PATIENCE_S,
    SHORT_STALL,
    Counting,
    Slots,
    claimed,
    ready_dataset,
    taken_by_somebody,
)
from workers.database import job_queue
from workers.database.database import Database
from workers.database.statistics import fold_use
from workers.engine import Stores
from workers.jobs.claim import Claim
from workers.jobs.job_states import Requeue, requeue_lost
from workers.jobs.ledger import Ledger
from workers.queue.janitor import release_worker
from workers.settings.errors import LimitReached
from workers.settings.settings import Settings

pytestmark = pytest.mark.anyio
# Says in its result what it used by its own account, with a child that it waited for; then ends as the plan says.
BURNING = """
import json, os, pathlib, resource, signal, subprocess, sys, time
os.chdir(sys.argv[1])
plan = json.loads(pathlib.Path("input/plan.json").read_text())
burn = "import time\\nwhile time.process_time() < 0.4: pass"
subprocess.run([sys.executable, "-c", burn])
while time.process_time() < 0.6: pass
if plan["end"] == "die":
    os.kill(os.getpid(), signal.SIGKILL)
if plan["end"] == "wait":
    time.sleep(600)
if plan["end"] == "fail":
    pathlib.Path("error.json").write_text(json.dumps({"code": "diverged", "detail": "x", "where": "", "hint": ""}))
    sys.exit(3)
used = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
report = {"steps": 0, "used": sum(part.ru_utime + part.ru_stime for part in used)}
pathlib.Path("output/report.json").write_text(json.dumps(report))
"""
BURNT_S = 0.95  # the kernel counts ticks of a hundredth


def today() -> date:
    """Asked each time: midnight may pass while the tests run."""
    return datetime.now(UTC).date()


@pytest.fixture
def burning(settings: Settings) -> Settings:
    return settings.model_copy(update={"job_command": (sys.executable, "-c", BURNING), "max_attempts": 2})


@pytest.fixture
def database(stores: Stores) -> Database:
    return stores.jobs._database


async def records(database: Database) -> list[dict[str, Any]]:
    return await database.fetch("SELECT * FROM use_records ORDER BY wall_s")


async def noted_s(database: Database) -> float:
    (row,) = await database.fetch("SELECT attempt_processor_s FROM jobs")
    return float(row["attempt_processor_s"])


async def test_processor_seconds_are_those_that_the_process_and_its_children_count_themselves(
    counting: Counting, burning: Settings, slots: Slots
):
    slots.start(burning, "a")
    await counting.submit(0, 0.0, end="finish")
    job = await counting.until_final()
    own_s = float((await counting.result())["used"])
    assert own_s > BURNT_S
    assert own_s <= job.use.processor_s < own_s + 0.3, "and its start before, and its end after"
    assert job.started_at is not None
    assert job.finished_at is not None
    assert job.use.wall_s == pytest.approx((job.finished_at - job.started_at).total_seconds(), abs=0.1)
    assert job.use.gpu_s == 0.0


async def _until_burnt(counting: Counting) -> None:
    await counting.until(lambda job: job.state == "running")
    async with asyncio.timeout(PATIENCE_S):
        while await noted_s(counting.stores.jobs._database) < BURNT_S:
            await asyncio.sleep(0.05)


@pytest.mark.parametrize(
    ("end", "state"), [("finish", "succeeded"), ("fail", "failed"), ("die", "failed"), ("wait", "cancelled")]
)
async def test_each_attempt_counts_once_however_it_ends(
    counting: Counting, burning: Settings, slots: Slots, end: str, state: str
):
    database, began_on = counting.stores.jobs._database, today()
    slots.start(burning, "a")
    await counting.submit(0, 0.0, end=end)
    if end == "wait":
        await _until_burnt(counting)
        await counting.stores.jobs.cancel(counting.id)
    job = await counting.until_final()
    assert job.state == state
    attempts = (await counting.events()).count("started")
    assert attempts == (2 if end == "die" else 1)
    counted = await records(database)
    assert [record["attempts"] for record in counted] == [1] * attempts
    assert all(BURNT_S <= record["processor_s"] < 3 * BURNT_S for record in counted), "killed ones as well"
    assert job.use.processor_s == pytest.approx(sum(record["processor_s"] for record in counted))
    assert job.use.wall_s == pytest.approx(sum(record["wall_s"] for record in counted))
    assert {record["day"] for record in counted} <= {began_on, today()}


async def test_an_attempt_that_is_stopped_counts_and_so_does_the_next(
    counting: Counting, burning: Settings, slots: Slots
):
    database = counting.stores.jobs._database
    first = slots.start(burning, "a")
    await counting.submit(0, 0.0, end="wait")
    await _until_burnt(counting)
    first.terminate()
    first.wait()
    (record,) = await records(database)
    job = await counting.until(lambda job: job.state == "queued")
    assert (job.attempt, job.use.processor_s) == (0, record["processor_s"])
    slots.start(burning, "b")
    await _until_burnt(counting)
    await counting.stores.jobs.cancel(counting.id)
    await counting.until_final()
    assert len(await records(database)) == 2


async def test_of_a_lost_worker_counts_what_was_known_at_its_last_beat(
    counting: Counting, burning: Settings, slots: Slots
):
    database = counting.stores.jobs._database
    slow = burning.model_copy(update=SHORT_STALL)
    first = slots.start(slow, "a")
    await counting.submit(0, 0.0, end="wait")
    await _until_burnt(counting)
    (alive,) = await database.fetch(
        "SELECT extract(epoch FROM clock_timestamp() - attempt_started_at)::float8 AS s FROM jobs"
    )
    first.kill()
    first.wait()
    await counting.stores.jobs.cancel(counting.id)
    slots.start(slow, "b")
    await counting.until_final()
    (record,) = await records(database)
    assert BURNT_S <= record["processor_s"] < 3 * BURNT_S
    # Not the stall time, nor the wait for a janitor.
    assert record["wall_s"] == pytest.approx(alive["s"], abs=slow.beat_s + 1.0)


async def test_time_on_a_slot_with_a_gpu_is_gpu_time_but_for_exports(
    stores: Stores, database: Database, counting: Counting, settings: Settings, slots: Slots
):
    slots.start(settings, "gpu0")
    await counting.submit(3, 0.02)
    job = await counting.until_final()
    assert job.use.gpu_s == job.use.wall_s > 0
    assert [record["device"] for record in await records(database)] == ["gpu"]
    await database.fetch("UPDATE jobs SET kind = 'export', state = 'running', parent = id RETURNING id")
    await database.fetch("UPDATE jobs SET state = 'succeeded' RETURNING id")
    assert sorted(record["device"] for record in await records(database)) == ["cpu", "gpu"]


async def _begun(stores: Stores) -> Claim:
    """An attempt that began 100 s ago and was last seen 40 s ago, with 7 processor seconds."""
    database = stores.jobs._database
    await stores.jobs.submit(await ready_dataset(stores, {"plan.json": b"{}"}), RefineOptions(preset="fast"))
    claim = await claimed(database, (await taken_by_somebody(database)).job_id)
    assert claim is not None
    await Ledger(database, claim, 60.0).note_use(7.0)
    await database.fetch(
        "UPDATE jobs SET attempt_started_at = clock_timestamp() - interval '100 s',"
        " attempt_seen_at = clock_timestamp() - interval '40 s' RETURNING id"
    )
    return claim


async def _failed(database: Database, claim: Claim) -> None:
    await Ledger(database, claim, 60.0).fail(JobError(code="timeout", detail="x"), [])
    await Ledger(database, claim, 60.0).fail(JobError(code="timeout", detail="x"), [])  # its answer was lost


async def _given_back(database: Database, claim: Claim) -> None:
    await Ledger(database, claim, 60.0).give_back(Requeue("requeued", {"why": "shutdown"}))
    await release_worker(database, None, 60.0)


async def _lost(database: Database, claim: Claim) -> None:
    await release_worker(database, None, 60.0)
    await release_worker(database, None, 60.0)


async def _lost_after_its_cancel(database: Database, claim: Claim) -> None:
    await database.fetch("UPDATE jobs SET cancel_requested = true RETURNING id")
    await release_worker(database, None, 60.0)


async def _forgotten_by_the_queue(database: Database, claim: Claim) -> None:
    await database.fetch("UPDATE jobs SET updated_at = updated_at - interval '1 hour' RETURNING id")
    async with database.transaction() as connection:
        for entry in await job_queue.entries_of_worker(connection, None):
            await job_queue.abort(connection, entry)
        await requeue_lost(connection, 60.0)


async def _claimed_again(database: Database, claim: Claim) -> None:
    assert await claimed(database, claim.job_id) is not None


async def _claimed_too_often(database: Database, claim: Claim) -> None:
    await database.fetch("UPDATE jobs SET crashes = 3 RETURNING id")
    assert await claimed(database, claim.job_id) is None


@pytest.mark.parametrize(
    ("end", "wall_s"),
    [
        (_failed, 100),
        (_given_back, 100),
        (_lost, 60),
        (_lost_after_its_cancel, 60),
        (_forgotten_by_the_queue, 60),
        (_claimed_again, 60),
        (_claimed_too_often, 60),
    ],
    ids=lambda value: getattr(value, "__name__", str(value)),
)
async def test_an_end_that_nobody_wrote_is_when_the_attempt_was_last_seen(
    stores: Stores, database: Database, end: Callable[[Database, Claim], Awaitable[None]], wall_s: float
):
    claim = await _begun(stores)
    await end(database, claim)
    (record,) = await records(database)
    assert record["wall_s"] == pytest.approx(wall_s, abs=5)
    assert record["processor_s"] == 7.0
    use = (await stores.jobs.get(claim.job_id)).use
    assert (use.processor_s, use.wall_s) == (7.0, record["wall_s"])


async def _used(
    database: Database, tenant: str, key_id: str, day: str, wall_s: float, device: str = "cpu"
) -> None:
    await database.fetch(
        "INSERT INTO use_records (day, tenant, key_id, device, processor_s, wall_s)"
        " VALUES (%s, %s, %s, %s, 2 * %s, %s) RETURNING day",
        *(day, tenant, key_id, device, wall_s, wall_s),
    )


async def test_use_outlives_its_job_and_is_the_same_once_it_is_added_up(stores: Stores, database: Database):
    claim = await _begun(stores)
    await _failed(database, claim)
    for wall_s in (1.0, 2.0, 4.0):
        await _used(database, "anna", "key_1", "2026-01-31", wall_s)
    await _used(database, "anna", "key_1", "2026-02-01", 8.0, "gpu")
    await _used(database, "anna", "key_2", "2026-02-01", 16.0)
    keys = ("day", "tenant", "key")
    first, last = datetime(2026, 1, 31).date(), today() + timedelta(1)
    before = await stores.tenants.usage(first, last, keys, None, 9)
    await stores.jobs.delete(claim.job_id)
    for _ in range(2):
        await database.run(fold_use)
        assert await stores.tenants.usage(first, last, keys, None, 9) == before
    assert len(await records(database)) == len(before) == 4
    assert [
        (row.tenant, row.key_id, row.attempts, row.wall_s, row.processor_s, row.gpu_s) for row in before[:3]
    ] == [
        ("anna", "key_1", 3, 7.0, 14.0, 0.0),
        ("anna", "key_1", 1, 8.0, 16.0, 8.0),
        ("anna", "key_2", 1, 16.0, 32.0, 0.0),
    ]
    (anna,) = await stores.tenants.usage(first, first, ["tenant"], "anna", 9)
    assert (anna.day, anna.tenant, anna.key_id, anna.wall_s) == (None, "anna", None, 7.0)
    assert [row.wall_s for row in await stores.tenants.usage(first, last, ["device"], "anna", 9)] == [
        23.0,
        8.0,
    ]


async def test_a_tenant_at_its_seconds_of_the_day_submits_no_more_until_midnight(
    stores: Stores, database: Database
):
    dataset = await ready_dataset(stores, {"plan.json": b"{}"})
    await stores.tenants.set("local", max_daily_seconds=150)
    yesterday = "(clock_timestamp() AT TIME ZONE 'UTC')::date - 1"
    await _used(database, "local", "", "2026-01-31", 500.0)
    await _used(database, "anna", "", str(today()), 500.0)
    await database.fetch(f"UPDATE use_records SET day = {yesterday} WHERE tenant = 'local' RETURNING day")
    claim = await _begun(stores)
    assert (await stores.tenants.share("local")).seconds_today == pytest.approx(100, abs=5), "it still runs"
    await stores.jobs.submit(dataset, RefineOptions(preset="fast"))
    await _used(database, "local", "", str(today()), 51.0)
    with pytest.raises(LimitReached) as refused:
        await stores.jobs.submit(dataset, RefineOptions(preset="fast"))
    assert refused.value.code == "daily_limit_reached"
    assert "max_daily_seconds is 150" in str(refused.value)
    (row,) = await database.fetch("SELECT (clock_timestamp() AT TIME ZONE 'UTC')::date + 1 AS tomorrow")
    assert f"{row['tomorrow']}T00:00:00" in str(refused.value)
    assert await Ledger(database, claim, 60.0).publish([], None), "what runs goes on"
    await stores.tenants.set("local", max_daily_seconds=0)
    await stores.jobs.submit(dataset, RefineOptions(preset="fast"))


async def test_metrics_name_the_first_hundred_tenants_alone(stores: Stores, database: Database):
    async def seconds() -> dict[str, float]:
        tallies = (await stores.monitor.statistics()).tallies
        return {tally["label"]: tally["amount"] for tally in tallies if tally["name"] == "wall_seconds"}

    await _failed(database, await _begun(stores))
    assert await seconds() == {"local": pytest.approx(100, abs=5)}
    await database.fetch(
        "INSERT INTO tenants (id, created_at) SELECT 't' || n, '2020-01-01' FROM generate_series(1, 100) AS n"
        " RETURNING id"
    )
    await _failed(database, await _begun(stores))
    assert await seconds() == {"local": pytest.approx(100, abs=5), "(others)": pytest.approx(100, abs=5)}
