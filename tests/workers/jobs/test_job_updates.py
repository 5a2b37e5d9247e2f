"""Following a job: a gapless history, every change seen, by any number of followers, from where they left off."""

from __future__ import annotations

import asyncio

import psycopg
import pytest

from biresnerf.options.refine_options import RefineOptions
from workers.database.database import open_database
from workers.engine import Stores, open_stores
from workers.jobs.jobs import JobStore
from workers.records import JobUpdate
from workers.settings.errors import NotFound
from workers.settings.settings import Settings

pytestmark = pytest.mark.anyio
FAST = RefineOptions(preset="fast")


async def test_events_are_gapless_and_resume_after_any_of_them(
    stores: Stores, dataset_id: str, database_url: str
):
    job, _ = await stores.jobs.submit(dataset_id, FAST)

    async def write(n: int) -> None:
        async with await psycopg.AsyncConnection.connect(database_url) as connection:
            for _ in range(20):
                await connection.execute("SELECT add_job_event(%s, 'stage', '{}')", (job.id,))
                if n == 0:
                    await connection.rollback()  # a writer that fails must not leave a gap
                else:
                    await connection.commit()

    await asyncio.gather(*(write(n) for n in range(4)))
    events = (await stores.jobs.update(job.id)).events
    assert [event.seq for event in events] == list(range(1, 62))
    for after in (0, 1, 30, 60, 61):
        assert [event.seq for event in (await stores.jobs.update(job.id, after=after)).events] == list(
            range(after + 1, 62)
        )


async def test_a_follower_sees_every_event_once_and_the_end(
    stores: Stores, dataset_id: str, settings: Settings
):
    job, _ = await stores.jobs.submit(dataset_id, FAST)
    seen: list[JobUpdate] = []

    async def follow(from_another_process: Stores) -> None:
        async for update in from_another_process.jobs.subscribe(job.id):
            if update is not None:
                seen.append(update)

    async with open_stores(settings) as other:
        following = asyncio.create_task(follow(other))
        async with open_database(settings.require_database_url()) as database:
            for _ in range(5):
                await asyncio.sleep(0.05)
                await database.fetch("SELECT add_job_event(%s, 'stage', '{}')", job.id)
        await stores.jobs.cancel(job.id)
        await asyncio.wait_for(following, 5)
    assert [event.seq for update in seen for event in update.events] == [1, 2, 3, 4, 5, 6, 7]
    assert seen[-1].job.state == "cancelled"


async def test_a_follower_that_comes_back_gets_what_it_missed(stores: Stores, dataset_id: str):
    job, _ = await stores.jobs.submit(dataset_id, FAST)
    await stores.jobs.cancel(job.id)
    updates = [update async for update in stores.jobs.subscribe(job.id, after=1)]
    assert [event.type for update in updates for event in update.events] == ["cancelled"]


async def test_a_quiet_job_gives_a_heartbeat_and_a_deleted_one_ends(stores: Stores, dataset_id: str):
    job, _ = await stores.jobs.submit(dataset_id, FAST)
    updates = stores.jobs.subscribe(job.id, heartbeat_s=0.1)
    assert (await anext(updates)) is not None
    assert (await anext(updates)) is None
    await stores.jobs.cancel(job.id)
    await stores.jobs.delete(job.id)

    async def to_the_end() -> None:
        async for _ in updates:
            pass

    with pytest.raises(NotFound):
        await asyncio.wait_for(to_the_end(), 5)


async def test_waiting_ends_with_the_job_or_with_the_time(stores: Stores, dataset_id: str):
    job, _ = await stores.jobs.submit(dataset_id, FAST)
    assert (await stores.jobs.wait(job.id, timeout_s=0.2)).state == "queued"
    waiting = asyncio.create_task(stores.jobs.wait(job.id, timeout_s=20))
    await asyncio.sleep(0.1)
    await stores.jobs.cancel(job.id)
    assert (await asyncio.wait_for(waiting, 5)).state == "cancelled"


async def test_followers_of_one_job_read_it_together_and_all_see_everything(
    stores: Stores, dataset_id: str, settings: Settings, monkeypatch: pytest.MonkeyPatch
):
    job, _ = await stores.jobs.submit(dataset_id, FAST)
    read, reads = JobStore.update, []

    async def counted(store: JobStore, job_id: str, after: int = 0) -> JobUpdate:
        reads.append(after)
        return await read(store, job_id, after)

    monkeypatch.setattr(JobStore, "update", counted)

    async def follow() -> list[int]:
        return [
            event.seq async for update in stores.jobs.subscribe(job.id) if update for event in update.events
        ]

    following = [asyncio.create_task(follow()) for _ in range(50)]
    await asyncio.sleep(0.3)
    async with open_database(settings.require_database_url()) as database:
        for _ in range(5):
            await database.fetch("SELECT add_job_event(%s, 'requeued', '{}')", job.id)
            await asyncio.sleep(0.2)
    await stores.jobs.cancel(job.id)
    assert set(map(tuple, await asyncio.gather(*following))) == {tuple(range(1, 8))}
    assert len(reads) < 50, "fewer reads than followers, over seven changes"


async def test_a_change_whose_notification_was_lost_is_seen_by_looking(
    settings: Settings, dataset_id: str, database_url: str
):
    async with open_stores(settings) as stores:
        job, _ = await stores.jobs.submit(dataset_id, FAST)
        updates = stores.jobs.subscribe(job.id, heartbeat_s=60)
        await anext(updates)
        async with await psycopg.AsyncConnection.connect(database_url) as connection:
            await connection.execute("UPDATE jobs SET revision = revision + 1, message = 'unheard'")
        async with asyncio.timeout(10):
            while (update := await anext(updates)) is None or update.job.message != "unheard":
                continue
        await updates.aclose()
