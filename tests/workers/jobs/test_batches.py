"""Many jobs in one call: all or none, and a single event at the end."""

from __future__ import annotations

import asyncio
import json
from collections.abc import Awaitable, Callable
from typing import Any

import pytest

from biresnerf.errors import FaultError, InputError
from biresnerf.options.refine_options import RefineOptions
from biresnerf.wire.batches import BatchView, NewBatch
from biresnerf.wire.jobs import NewJob
from biresnerf.wire.problems import JobError
from biresnerf.wire.webhooks import ALL_EVENTS, BatchWebhook, new_secret
from tests.workers.conftest import Slots, claimed, ready_dataset, taken_by_somebody
from tests.workers.webhooks.test_webhooks import waiting_for_locks
from workers.database.database import Connection, Database, open_database
from workers.engine import Stores
from workers.jobs.batches import Batches
from workers.jobs.claim import Claim
from workers.jobs.deadlines import end_overdue_jobs
from workers.jobs.job_expiry import forget_keys
from workers.jobs.job_states import finish
from workers.jobs.ledger import Ledger
from workers.queue.janitor import release_worker
from workers.settings.errors import Conflict, LimitReached, NotFound
from workers.settings.settings import Settings

pytestmark = pytest.mark.anyio
FAST = RefineOptions(preset="fast")
STALL_S = 2.0
HOOK_URL = "https://hooks.example.org/in"


def asked(*dataset_ids: str, webhook: BatchWebhook | None = None, **details: Any) -> NewBatch:
    jobs = [
        NewJob(dataset_id=name, options=FAST, labels={"n": str(place)}, **details)
        for place, name in enumerate(dataset_ids)
    ]
    return NewBatch(jobs=tuple(jobs), webhook=webhook)


@pytest.fixture
def batches(stores: Stores) -> Batches:
    return Batches(stores.jobs.for_tenant("local"))


@pytest.fixture
async def hook(stores: Stores) -> str:
    """A webhook that wants all there is."""
    made, _ = await stores.webhooks.create("local", HOOK_URL, ALL_EVENTS)
    return made.id


async def told(stores: Stores, hook: str) -> list[dict[str, Any]]:
    """The ends of batches that were told."""
    items = (await stores.webhooks.deliveries(hook, limit=200)).items
    return [json.loads(item.body)["data"] for item in items if item.event == "batch.finished"]


async def test_a_batch_shows_its_jobs_in_order_and_what_becomes_of_them(
    stores: Stores, batches: Batches, dataset_id: str
):
    other = await ready_dataset(stores, {"plan.json": b"{ }"})
    batch, new = await batches.submit_batch(asked(dataset_id, other, dataset_id))
    assert new
    assert [(job.dataset_id, job.labels) for job in batch.jobs] == [
        (dataset_id, {"n": "0"}),
        (other, {"n": "1"}),
        (dataset_id, {"n": "2"}),
    ]
    assert (batch.counts, batch.finished_at, batch.final) == ({"queued": 3}, None, False)
    jobs = [await stores.jobs.get(job.id) for job in batch.jobs]
    assert {job.batch_id for job in jobs} == {batch.id}
    assert [job.queue_position for job in jobs] == [1, 2, 3]
    await stores.jobs.cancel(batch.jobs[1].id)
    now = await batches.batch(batch.id)
    assert now.counts == {"queued": 2, "cancelled": 1}
    assert [job.state for job in now.jobs] == ["queued", "cancelled", "queued"]


async def test_a_batch_that_cannot_be_queued_whole_is_not_queued_at_all(
    stores: Stores, batches: Batches, dataset_id: str
):
    """And the error says which job is at fault."""
    open_one = (await stores.datasets.create("open")).id
    wrong = {"options": RefineOptions(preset="fast", coarse_steps_min=10**6)}
    jobs = (*asked(dataset_id).jobs, NewJob(dataset_id=dataset_id, **wrong))
    with pytest.raises(InputError) as contradiction:
        await batches.submit_batch(NewBatch(jobs=jobs))
    assert contradiction.value.fault.where.startswith("jobs/1")
    await stores.tenants.set("local", max_queued=2)
    tries: list[tuple[NewBatch, type[FaultError], str, str]] = [
        (asked(dataset_id, dataset_id, dataset_id), LimitReached, "quota_exhausted", "jobs/2"),
        (asked(dataset_id, open_one), Conflict, "dataset_not_ready", "jobs/1"),
        (asked(dataset_id, "ds_0"), NotFound, "not_found", ""),
        (asked(dataset_id, dataset_id, fixed_from="job_0"), NotFound, "not_found", "jobs/0"),
    ]
    for batch, kind, code, where in tries:
        with pytest.raises(kind) as refused:
            await batches.submit_batch(batch, idempotency_key="k")
        assert (refused.value.fault.code, refused.value.fault.where) == (code, where)
    for table in ("jobs", "batches", "queue_entries", "webhooks", "job_events"):
        (row,) = await stores.jobs._database.fetch(f"SELECT count(*) AS n FROM {table}")
        assert row["n"] == 0, table
    await batches.submit_batch(asked(dataset_id, dataset_id), idempotency_key="k")


async def test_the_same_key_gives_the_same_batch_and_another_request_is_refused(
    stores: Stores, batches: Batches, dataset_id: str
):
    request = asked(dataset_id, dataset_id)
    found = await asyncio.gather(*(batches.submit_batch(request, idempotency_key="k") for _ in range(5)))
    assert len({batch.id for batch, _ in found}) == 1
    assert [new for _, new in found].count(True) == 1
    assert len((await stores.jobs.list()).items) == 2
    hook = BatchWebhook(url=HOOK_URL, secret=new_secret())
    for other in (
        asked(dataset_id),
        asked(dataset_id, dataset_id, priority="low"),
        asked(dataset_id, dataset_id, webhook=hook),
    ):
        with pytest.raises(Conflict) as refused:
            await batches.submit_batch(other, idempotency_key="k")
        assert refused.value.code == "idempotency_key_reused"
    await batches.cancel_batch(found[0][0].id)
    await stores.jobs._database.fetch(
        "UPDATE batches SET finished_at = finished_at - interval '2 days' RETURNING id"
    )
    await stores.jobs._database.run(forget_keys, 86_400.0)
    again, new = await batches.submit_batch(request, idempotency_key="k")
    assert new
    assert again.id != found[0][0].id


async def _running(database: Database) -> Claim:
    claim = await claimed(database, (await taken_by_somebody(database)).job_id)
    assert claim is not None
    return claim


async def _succeeds(stores: Stores, _: str) -> None:
    database = stores.jobs._database
    assert await Ledger(database, await _running(database), STALL_S).publish([], None)


async def _fails(stores: Stores, _: str) -> None:
    database = stores.jobs._database
    await Ledger(database, await _running(database), STALL_S).fail(JobError(code="timeout", detail="x"), [])


async def _is_cancelled(stores: Stores, job_id: str) -> None:
    await stores.jobs.cancel(job_id)


async def _is_lost_after_its_cancel(stores: Stores, job_id: str) -> None:
    database = stores.jobs._database
    await _running(database)
    await stores.jobs.cancel(job_id)
    await release_worker(database, None, STALL_S)


async def _crashes_too_often(stores: Stores, job_id: str) -> None:
    database = stores.jobs._database
    await _running(database)
    await database.fetch("UPDATE jobs SET crashes = 3 WHERE id = %s RETURNING id", job_id)
    assert await claimed(database, job_id) is None


async def _expires(stores: Stores, job_id: str) -> None:
    late = "UPDATE jobs SET start_by = now() - interval '1 minute' WHERE id = %s RETURNING id"
    await stores.jobs._database.fetch(late, job_id)
    await stores.jobs._database.run(end_overdue_jobs, STALL_S)


@pytest.mark.parametrize(
    ("end", "state"),
    [
        (_succeeds, "succeeded"),
        (_fails, "failed"),
        (_is_cancelled, "cancelled"),
        (_is_lost_after_its_cancel, "cancelled"),
        (_crashes_too_often, "failed"),
        (_expires, "expired"),
    ],
    ids=["succeeds", "fails", "is_cancelled", "is_lost", "crashes", "expires"],
)
async def test_the_end_of_a_batch_is_told_once_however_its_last_job_ends(
    stores: Stores,
    batches: Batches,
    dataset_id: str,
    hook: str,
    end: Callable[[Stores, str], Awaitable[None]],
    state: str,
):
    batch, _ = await batches.submit_batch(asked(dataset_id, dataset_id))
    first, last = batch.jobs
    if state == "cancelled":  # the other one otherwise, so that both are counted
        await _succeeds(stores, first.id)
    else:
        await stores.jobs.cancel(first.id)
    assert (await told(stores, hook), (await batches.batch(batch.id)).final) == ([], False)
    await end(stores, last.id)
    over = await batches.batch(batch.id)
    assert over.jobs[1].state == state
    assert over.finished_at is not None
    ended = (await stores.jobs.get(last.id)).finished_at
    assert ended is not None
    assert 0 <= (over.finished_at - ended).total_seconds() < 10
    (data,) = await told(stores, hook)
    assert data["counts"] == over.counts
    assert sum(over.counts.values()) == 2
    assert (data["id"], data["links"]["self"]) == (batch.id, over.links.self)
    assert data["finished_at"] == over.finished_at.isoformat().replace("+00:00", "Z")


async def test_two_jobs_that_end_at_the_same_moment_are_told_as_one_end(
    stores: Stores, batches: Batches, dataset_id: str, hook: str, settings: Settings
):
    """Neither transaction sees what the other one has written when both come to their end."""
    batch, _ = await batches.submit_batch(asked(dataset_id, dataset_id))

    async def ended(connection: Connection, place: int) -> None:
        await connection.execute("SELECT 1 FROM jobs WHERE id = %s FOR UPDATE", (batch.jobs[place].id,))
        await finish(connection, batch.jobs[place].id, "succeeded", None)

    async with open_database(settings.require_database_url()) as database:

        async def second() -> None:
            async with database.transaction() as connection:
                await ended(connection, 1)

        async with database.transaction() as connection:
            await ended(connection, 0)
            await connection.execute("SET CONSTRAINTS ALL IMMEDIATE")  # as if it were just being committed
            other = asyncio.create_task(second())
            await waiting_for_locks(database, 1)
            assert await told(stores, hook) == []
        await other
    assert len(await told(stores, hook)) == 1
    assert (await batches.batch(batch.id)).counts == {"succeeded": 2}


async def test_jobs_that_end_in_one_transaction_or_in_many_at_once_are_told_once(
    stores: Stores, batches: Batches, dataset_id: str, hook: str
):
    """By the janitor, and by as many clients as there are jobs. Of several batches, each has its own end."""
    made = [
        (await batches.submit_batch(asked(*[dataset_id] * 4, expires_in_queue_s=60)))[0] for _ in range(3)
    ]
    late = "UPDATE jobs SET start_by = now() - interval '1 minute' WHERE batch_id = %s RETURNING id"
    await stores.jobs._database.fetch(late, made[0].id)
    await stores.jobs._database.run(end_overdue_jobs, STALL_S)
    assert [data["counts"] for data in await told(stores, hook)] == [{"expired": 4}]
    clients = [stores.jobs.cancel(job.id) for batch in made[1:] for job in batch.jobs]
    await asyncio.gather(*clients, batches.cancel_batch(made[2].id))
    assert sorted(data["id"] for data in await told(stores, hook)) == sorted(batch.id for batch in made)


async def test_a_batch_is_cancelled_with_what_its_jobs_have(
    stores: Stores, batches: Batches, dataset_id: str
):
    batch, _ = await batches.submit_batch(asked(dataset_id, dataset_id, dataset_id))
    claim = await _running(stores.jobs._database)
    asked_for = await batches.cancel_batch(batch.id, keep_partial=True)
    assert (asked_for.counts, asked_for.final) == ({"running": 1, "cancelled": 2}, False)
    ledger = Ledger(stores.jobs._database, claim, STALL_S)
    assert await ledger.wants_partial()
    await ledger.cancelled([], ledger.claim.name)
    assert (await batches.cancel_batch(batch.id)).final


async def test_the_webhook_of_a_batch_hears_of_its_end_alone(
    stores: Stores, batches: Batches, dataset_id: str, hook: str
):
    wanted = BatchWebhook(url=HOOK_URL, secret=new_secret())
    batch, _ = await batches.submit_batch(asked(dataset_id, webhook=wanted))
    other, _ = await batches.submit_batch(asked(dataset_id))
    for one in (batch, other):
        await batches.cancel_batch(one.id)
    (own,) = (await stores.webhooks.list(job_id=batch.id)).items
    assert (own.batch_id, own.job_id, own.events) == (batch.id, None, ("batch.finished",))
    (delivery,) = (await stores.webhooks.deliveries(own.id)).items
    assert json.loads(delivery.body)["data"]["id"] == batch.id
    assert [item.id for item in (await stores.webhooks.list()).items] == [hook], "it is none for all jobs"
    assert len(await told(stores, hook)) == 2


async def test_a_batch_goes_with_its_last_job_and_its_webhook_with_it(
    stores: Stores, batches: Batches, dataset_id: str
):
    """Also where the last two are deleted at the same moment."""
    wanted = BatchWebhook(url=HOOK_URL, secret=new_secret())
    batch, _ = await batches.submit_batch(asked(*[dataset_id] * 3, webhook=wanted))
    await batches.cancel_batch(batch.id)
    first, second, third = batch.jobs
    await stores.jobs.delete(first.id)
    assert len((await batches.batch(batch.id)).jobs) == 2
    async with stores.jobs._database.transaction() as connection:
        await connection.execute("DELETE FROM jobs WHERE id = %s", (second.id,))
        deleting = asyncio.create_task(stores.jobs.delete(third.id))
        await asyncio.wait({deleting}, timeout=1)
    await deleting
    with pytest.raises(NotFound):
        await batches.batch(batch.id)
    assert (await stores.webhooks.list(job_id=batch.id)).items == ()


async def test_a_batch_of_another_tenant_is_not_there(stores: Stores, batches: Batches, dataset_id: str):
    await stores.tenants.set("anna")
    annas = Batches(stores.jobs.for_tenant("anna"))
    batch, _ = await batches.submit_batch(asked(dataset_id))
    for call in (annas.batch, annas.cancel_batch):
        with pytest.raises(NotFound):
            await call(batch.id)
    with pytest.raises(NotFound):
        await annas.submit_batch(asked(dataset_id))
    assert (await batches.batch(batch.id)).counts == {"queued": 1}


async def test_workers_run_a_batch_and_its_end_is_told_once(
    stores: Stores, batches: Batches, settings: Settings, slots: Slots, hook: str
):
    for name in ("a", "b"):
        slots.start(settings, name)
    plan = {"steps": 3, "step_s": 0.01, "journal": "/dev/null"}
    refused = {**plan, "refuse": True}
    sets = [
        await ready_dataset(stores, {"plan.json": json.dumps(one).encode()}) for one in (plan, refused, plan)
    ]
    batch, _ = await batches.submit_batch(asked(*sets, *sets))
    over = await _over(batches, batch.id)
    assert over.counts == {"succeeded": 4, "failed": 2}
    assert [job.state for job in over.jobs] == ["succeeded", "failed", "succeeded"] * 2
    assert [data["counts"] for data in await told(stores, hook)] == [over.counts]


async def _over(batches: Batches, batch_id: str) -> BatchView:
    async with asyncio.timeout(90):
        while not (found := await batches.batch(batch_id)).final:
            await asyncio.sleep(0.05)
    return found
