"""Whose job runs next, and how many of one tenant run at once: asked of the queue itself, as a worker does."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from contextlib import AsyncExitStack

import psycopg
import pytest

from biresnerf.options.refine_options import RefineOptions
from biresnerf.wire.jobs import PriorityName
from tests.workers.conftest import ready_dataset
from workers.database import job_queue
from workers.database.database import Database, open_database
from workers.engine import Stores, open_stores
from workers.jobs.claim import claim_job
from workers.jobs.job_states import finish
from workers.settings.errors import Conflict, LimitReached
from workers.settings.settings import Settings

pytestmark = pytest.mark.anyio
FAST = RefineOptions(preset="fast")


class Line:
    """Submits jobs called A0, B1, … and takes them from the queue's front."""

    def __init__(self, stores: Stores, database: Database) -> None:
        self.stores, self.database = stores, database
        self._datasets: dict[str, str] = {}
        self.ids: dict[str, str] = {}

    async def tenant(self, name: str, **limits: float) -> None:
        await self.stores.tenants.set(name.lower(), **{"max_running": 0, **limits})

    async def submit(
        self, name: str, priority: PriorityName = "normal", options: RefineOptions = FAST
    ) -> None:
        tenant = name.rstrip("0123456789").lower()
        if tenant not in self._datasets:
            async with self.database.transaction() as connection:
                await connection.execute(
                    "INSERT INTO tenants (id, max_running) VALUES (%s, 0) ON CONFLICT DO NOTHING", (tenant,)
                )
            own = Stores(**{**vars(self.stores), "datasets": self.stores.datasets.for_tenant(tenant)})
            self._datasets[tenant] = await ready_dataset(own, {"plan.json": b"{}"})
        job, _ = await self.stores.jobs.for_tenant(tenant).submit(
            self._datasets[tenant], options, priority=priority
        )
        self.ids[job.id] = name

    async def start(self) -> str:
        """The name of the job that a free worker gets now; empty where it gets none."""
        async with self.database.transaction() as connection:
            worker_id = await job_queue.register_worker(connection)
            entry = await job_queue.take(connection, worker_id)
        if entry is None:
            return ""
        assert await claim_job(self.database, entry.job_id, worker_id, 3, 60.0) is not None
        return self.ids[entry.job_id]

    async def end(self, name: str) -> None:
        (job_id,) = [key for key, value in self.ids.items() if value == name]
        async with self.database.transaction() as connection:
            await finish(connection, job_id, "succeeded", None)

    async def run_all(self) -> list[str]:
        """All jobs, one at a time."""
        order = []
        while name := await self.start():
            order.append(name)
            await self.end(name)
        return order


@pytest.fixture
async def line(stores: Stores, settings: Settings) -> AsyncIterator[Line]:
    async with open_database(settings.require_database_url(), connections=2) as database:
        yield Line(stores, database)


async def test_tenants_that_wait_take_turns_however_many_jobs_each_sent(line: Line):
    await line.tenant("vip", top_priority="high")
    for name in ("A0", "A1", "A2", "A3", "A4", "B0", "B1", "B2", "C0"):
        await line.submit(name)
    await line.submit("VIP", priority="high")
    assert await line.run_all() == ["VIP", "A0", "B0", "C0", "A1", "B1", "A2", "B2", "A3", "A4"]


async def test_what_was_used_while_nobody_waited_is_not_held_against_a_tenant(line: Line):
    for number in range(6):
        await line.submit(f"A{number}")
    await line.run_all()
    for name in ("A6", "A7", "A8", "B0", "B1", "B2"):
        await line.submit(name)
    assert await line.run_all() == ["A6", "B0", "A7", "B1", "A8", "B2"]


async def test_a_newcomer_waits_for_one_turn_of_a_tenant_with_hundreds_of_jobs(line: Line):
    for number in range(60):
        await line.submit(f"A{number}")
    assert [await line.start() for _ in range(10)] == [f"A{number}" for number in range(10)]
    await line.submit("B0")
    (job_id,) = [key for key, value in line.ids.items() if value == "B0"]
    assert (await line.stores.jobs.get(job_id)).queue_position == 2
    assert [await line.start(), await line.start()] == ["A10", "B0"]


async def test_a_tenant_of_twice_the_weight_gets_twice_the_turns(line: Line):
    await line.tenant("A", weight=2.0)
    for number in range(6):
        await line.submit(f"A{number}")
        await line.submit(f"B{number}")
    first = (await line.run_all())[:6]
    assert sorted(name[0] for name in first) == ["A", "A", "A", "A", "B", "B"]


async def test_long_jobs_cost_more_turns_than_short_ones(line: Line):
    long = RefineOptions(preset="fast", steps=12_000)
    for number in range(3):
        await line.submit(f"A{number}", options=long)
    for number in range(8):
        await line.submit(f"B{number}")
    order = await line.run_all()
    assert order.index("A1") > order.index("B6")  # 2 x 12000 steps against 7 x 3000


async def test_cancelled_jobs_leave_no_debt(line: Line):
    for number in range(30):
        await line.submit(f"A{number}")
    for job_id in list(line.ids):
        await line.stores.jobs.cancel(job_id)
    for name in ("A30", "B0", "A31", "B1"):
        await line.submit(name)
    assert await line.run_all() == ["A30", "B0", "A31", "B1"]


async def test_priorities_order_jobs_but_only_as_high_as_the_operator_allows(line: Line):
    await line.submit("A0", priority="low")
    await line.submit("A1")
    await line.submit("B0", priority="low")
    with pytest.raises(Conflict) as refused:
        await line.submit("A2", priority="high")
    assert refused.value.code == "priority_not_allowed"
    assert await line.run_all() == ["A1", "A0", "B0"]


async def test_many_jobs_of_one_class_do_not_make_another_class_wait_for_its_past(line: Line):
    await line.tenant("vip", top_priority="high")
    for number in range(20):
        await line.submit(f"VIP{number}", priority="high")
    for number in range(5):
        await line.submit(f"A{number}")
    for _ in range(20):
        assert (await line.start()).startswith("VIP")
    await line.submit("B0")
    assert [await line.start(), await line.start()] == ["A0", "B0"]


async def test_never_more_jobs_of_a_tenant_run_than_it_may_while_others_go_on(line: Line):
    await line.submit("A0")
    await line.tenant("A", max_running=2)
    for name in ("A1", "A2", "A3", "A4", "B0", "B1"):
        await line.submit(name)
    assert [await line.start() for _ in range(5)] == ["A0", "B0", "A1", "B1", ""]
    await line.end("A1")
    assert [await line.start(), await line.start()] == ["A2", ""]
    await line.end("A0")
    await line.end("A2")
    assert [await line.start(), await line.start(), await line.start()] == ["A3", "A4", ""]


async def test_a_cancelled_job_makes_room_as_one_that_ran(line: Line):
    await line.submit("A0")
    await line.tenant("A", max_running=1)
    await line.submit("A1")
    await line.submit("A2")
    by_name = {name: job_id for job_id, name in line.ids.items()}
    await line.stores.jobs.cancel(by_name["A1"])  # held
    await line.stores.jobs.cancel(by_name["A0"])  # before the queue
    assert [await line.start(), await line.start()] == ["A2", ""]


async def test_a_janitor_and_an_end_that_offer_at_once_offer_no_more_than_the_limit(
    line: Line, settings: Settings
):
    await line.submit("A0")
    await line.tenant("A", max_running=1)
    for number in range(1, 5):
        await line.submit(f"A{number}")
    assert [await line.start(), await line.start()] == ["A0", ""]
    by_name = {name: job_id for job_id, name in line.ids.items()}
    await line.database.fetch("UPDATE tenants SET max_running = 2 WHERE id = 'a'")  # as new settings do
    async with AsyncExitStack() as stack:
        url = settings.require_database_url()
        janitor = await stack.enter_async_context(await psycopg.AsyncConnection.connect(url))
        end = await stack.enter_async_context(await psycopg.AsyncConnection.connect(url))
        await janitor.execute("SELECT offer_held('a')")  # A1
        ended = "UPDATE jobs SET state = 'succeeded' WHERE id = %s"
        ending = asyncio.create_task(end.execute(ended, (by_name["A0"],)))
        # Not seen by the other yet: who did not wait would find nothing before the queue, and offer two.
        await asyncio.wait([ending], timeout=0.5)
        await janitor.commit()
        await ending
        await end.commit()
    assert [await line.start(), await line.start(), await line.start()] == ["A1", "A2", ""]


async def test_a_submit_that_hangs_holds_up_nobody_elses(line: Line, monkeypatch: pytest.MonkeyPatch):
    await line.submit("A0")
    await line.submit("B0")
    real, reached, go_on = job_queue.enqueue, asyncio.Event(), asyncio.Event()

    async def hang_once(*arguments, **options) -> int:
        if not reached.is_set():
            reached.set()
            await go_on.wait()
        return await real(*arguments, **options)

    monkeypatch.setattr(job_queue, "enqueue", hang_once)
    hanging = asyncio.create_task(line.submit("A1"))
    await reached.wait()
    async with asyncio.timeout(15):
        await line.submit("B1")
    assert not hanging.done()
    go_on.set()
    await hanging
    assert await line.run_all() == ["A0", "B0", "B1", "A1"]


async def test_a_raised_limit_holds_at_once(line: Line):
    await line.submit("A0")
    await line.tenant("A", max_running=1)
    await line.submit("A1")
    assert [await line.start(), await line.start()] == ["A0", ""]
    await line.tenant("A", max_running=2)
    assert await line.start() == "A1"


async def test_the_settings_limit_tenants_that_have_none_of_their_own(line: Line, settings: Settings):
    strict = settings.model_copy(update={"tenant_max_queued": 2, "tenant_max_running": 3})
    async with open_stores(strict) as stores:
        anna = await stores.tenants.set("anna")
        assert (anna.max_queued, anna.max_running) == (2, 3)
        own = await stores.tenants.set("anna", max_queued=7)
        assert own.max_queued == 7
        assert (await stores.tenants.set("anna", max_queued=-1)).max_queued == 2
        assert (await stores.tenants.share("local")).max_queued == 0


async def test_a_tenant_with_a_full_queue_is_refused_and_others_are_not(line: Line):
    await line.submit("A0")
    await line.tenant("A", max_queued=2)
    await line.submit("A1")
    with pytest.raises(LimitReached) as refused:
        await line.submit("A2")
    assert refused.value.code == "quota_exhausted"
    await line.submit("B0")
    await line.start()
    await line.submit("A2")


async def test_stored_bytes_are_counted_over_datasets_uploads_and_results(line: Line):
    await line.submit("A0")
    store = line.stores.datasets.for_tenant("a")
    before = (await line.stores.tenants.share("a")).stored_bytes
    assert before == len(b"{}")
    dataset = await store.create("more")

    async def content() -> AsyncIterator[bytes]:
        yield b"x" * 1000

    await store.add_file(dataset.id, "a.png", content())
    await store.add_file(dataset.id, "a.png", content())  # in place of the first
    upload = await line.stores.uploads.for_tenant("a").create(dataset.id, "archive", 500)
    async with line.database.transaction() as connection:
        await connection.execute(
            "UPDATE jobs SET artifacts = '[{\"size\": 7}, {\"size\": 3}]' WHERE tenant = 'a'"
        )
    assert (await line.stores.tenants.share("a")).stored_bytes == before + 1000 + 500 + 10
    assert (await line.stores.tenants.share("local")).stored_bytes == 0
    await line.tenant("a", max_stored_bytes=before + 1510 + 999)
    with pytest.raises(LimitReached) as refused:
        await store.add_file(dataset.id, "b.png", content())
    assert refused.value.code == "quota_exhausted"
    assert (await store.get(dataset.id)).files == 1
    with pytest.raises(LimitReached):
        await line.stores.uploads.for_tenant("a").create(dataset.id, "archive", 1000)
    await line.stores.uploads.for_tenant("a").delete(upload.id)
    await store.add_file(dataset.id, "b.png", content())
    await store.delete(dataset.id)
    assert (await line.stores.tenants.share("a")).stored_bytes == before + 10
