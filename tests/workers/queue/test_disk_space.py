"""Room for a job's files: a set that lies on the same disk takes none, one that must be fetched waits for it."""

from __future__ import annotations

import pytest

from tests.workers.buckets import environment_of, fresh_bucket, moto_server
from tests.workers.conftest import Counting, Slots, short_folder
from workers.engine import open_stores
from workers.jobs.setbacks import SETBACKS
from workers.settings.settings import Settings

pytestmark = pytest.mark.anyio
TOO_LARGE = 2**60  # bytes, for every disk


async def say_size(counting: Counting, size: int) -> None:
    """The size of the set's files, as the database has it."""
    async with counting.stores.jobs._database.transaction() as connection:
        await connection.execute("UPDATE dataset_files SET size = %s", (size,))


async def assert_waits_for_room(counting: Counting, settings: Settings, slots: Slots) -> None:
    await counting.submit(8, 0.01)
    await say_size(counting, TOO_LARGE)
    slots.start(settings, "a")
    waiting = await counting.until(lambda job: job.message == SETBACKS["disk_full"].message)
    assert waiting.state == "queued"
    await say_size(counting, 1)
    assert (await counting.until_final()).state == "succeeded"


async def test_a_set_on_the_same_disk_needs_no_room(counting: Counting, settings, slots: Slots):
    await counting.submit(8, 0.01)
    await say_size(counting, TOO_LARGE)
    slots.start(settings, "a")
    assert (await counting.until_final()).state == "succeeded"


async def test_a_set_in_a_bucket_waits_for_room_and_says_so(settings, slots: Slots, tmp_path):
    with moto_server() as address:
        settings = settings.model_copy(update=environment_of(fresh_bucket(address)))
        async with open_stores(settings) as stores:
            await assert_waits_for_room(Counting(stores, tmp_path / "journal"), settings, slots)


async def test_so_does_a_set_on_another_disk_than_running_jobs(counting: Counting, settings, slots: Slots):
    with short_folder() as elsewhere:
        settings.scratch_dir.symlink_to(elsewhere)
        if elsewhere.stat().st_dev == settings.files_dir.stat().st_dev:
            pytest.skip("there is no second disk")
        await assert_waits_for_room(counting, settings, slots)
        slots.end()  # it writes there
