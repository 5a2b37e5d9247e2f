"""How a running job ends on request: in time, once, and whatever dies meanwhile. Real processes, real signals."""

from __future__ import annotations

import asyncio

import psutil
import pytest

from tests.workers.conftest import Counting, Slots
from workers.settings.settings import Settings

pytestmark = pytest.mark.anyio


async def test_a_running_job_is_cancelled(counting: Counting, settings: Settings, slots: Slots):
    slots.start(settings, "a")
    await counting.submit(1000, 0.05)
    await counting.until(lambda job: job.progress.step >= 5)
    asked = await counting.stores.jobs.cancel(counting.id)
    assert asked.cancel_requested
    job = await counting.until_final(timeout_s=5)
    assert job.state == "cancelled"
    assert (await counting.events())[-2:] in (["cancel_requested", "cancelled"], ["checkpoint", "cancelled"])
    assert not psutil.pid_exists(int(counting.starts()[0]["pid"]))
    await counting.submit(3, 0.01)
    assert (await counting.until_final()).state == "succeeded", "the slot is free again"


async def test_a_deaf_job_is_killed_when_cancelled(counting: Counting, settings: Settings, slots: Slots):
    slots.start(settings.model_copy(update={"stop_grace_s": 0.5}), "a")
    await counting.submit(1000, 0.05, deaf=True)
    await counting.until(lambda job: job.progress.step >= 5)
    await counting.stores.jobs.cancel(counting.id)
    assert (await counting.until_final(timeout_s=5)).state == "cancelled"


async def test_cancelling_at_the_finish_line_leaves_one_consistent_end(
    counting: Counting, settings: Settings, slots: Slots
):
    slots.start(settings, "a")
    ends = set()
    for tenth in range(6):
        await counting.submit(6, 0.02)
        await counting.until(lambda job: job.progress.step >= 1)
        await asyncio.sleep(0.03 * tenth)
        await counting.stores.jobs.cancel(counting.id)
        job = await counting.until_final()
        events = await counting.events()
        ends.add(job.state)
        assert events[-1] == job.state
        assert sum(event in ("succeeded", "failed", "cancelled") for event in events) == 1
        if job.state == "succeeded":
            await counting.assert_one_result(6)
    assert ends <= {"succeeded", "cancelled"}


async def test_a_cancelled_job_of_a_dead_worker_ends_cancelled(
    counting: Counting, settings: Settings, slots: Slots
):
    first = slots.start(settings, "a")
    await counting.submit(1000, 0.05)
    await counting.until(lambda job: job.progress.step >= 1)
    first.kill()
    first.wait()
    await counting.stores.jobs.cancel(counting.id)
    slots.start(settings, "b")
    assert (await counting.until_final()).state == "cancelled"
    assert len(counting.starts()) == 1
