"""What stays free on a disk."""

from __future__ import annotations

import asyncio
import shutil
import time
from pathlib import Path

import pytest

from tests.workers.conftest import PATIENCE_S, Counting, Slots
from workers.process.disk_space import DiskBudget
from workers.settings.errors import LimitReached
from workers.settings.settings import Settings


def test_the_reserve_is_never_given_out(tmp_path: Path):
    free = shutil.disk_usage(tmp_path).free
    roomy = DiskBudget([tmp_path / "not" / "there", tmp_path], reserve_bytes=free // 2)
    assert 0 < roomy.free_bytes() < free * 0.6
    roomy.require(free // 4)
    for more in (free, free * 3 // 4):
        with pytest.raises(LimitReached) as caught:
            roomy.require(more)
        assert caught.value.code == "storage_full"
    full = DiskBudget([tmp_path], reserve_bytes=free * 2)
    assert full.free_bytes() == 0
    with pytest.raises(LimitReached):
        full.require()


@pytest.mark.anyio
async def test_a_job_waits_for_a_host_with_room(
    settings: Settings, counting: Counting, slots: Slots, tmp_path: Path
):
    full = settings.model_copy(update={"disk_reserve_bytes": 2**60, "stall_s": 4.0})
    slots.start(full, "full")
    await counting.submit(steps=2, step_s=0.01)
    log = tmp_path / "slot-full.log"
    end = time.monotonic() + PATIENCE_S
    while "the job waits for disk space" not in log.read_text():
        assert time.monotonic() < end, log.read_text()
        await asyncio.sleep(0.05)
    job = await counting.stores.jobs.get(counting.id)
    assert (job.state, job.attempt) == ("queued", 0)
    slots.start(settings, "roomy")
    assert (await counting.until_final()).state == "succeeded"
