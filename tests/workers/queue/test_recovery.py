"""What happens to a job when something dies. Real processes, real signals, real PostgreSQL."""

from __future__ import annotations

import asyncio
import os
import shutil
import signal
from pathlib import Path

import psutil
import pytest

from benchmarks.chaos.surroundings import WrongClock
from tests.workers.conftest import SHORT_STALL, Counting, Slots, died
from workers.engine import Stores
from workers.jobs.setbacks import LOSSES_PER_CRASH
from workers.settings.settings import Settings

pytestmark = pytest.mark.anyio


async def test_a_job_runs_reports_and_publishes(counting: Counting, settings: Settings, slots: Slots):
    slots.start(settings, "a")
    await counting.submit(12, 0.02)
    job = await counting.until_final()
    assert (job.state, job.attempt, job.progress.fraction, job.error) == ("succeeded", 1, 1.0, None)
    assert job.metrics["loss"] == pytest.approx(1 / 13)
    assert job.started_at is not None
    assert job.finished_at is not None
    events = await counting.events()
    assert events[:2] == ["queued", "started"]
    assert events[-1] == "succeeded"
    assert {"stage", "checkpoint"} <= set(events)
    assert counting.starts()[0]["database"] is False, "the job must not see the database's address"
    await counting.assert_one_result(12)


async def test_kill_9_of_the_worker_moves_the_job_to_another_one(
    counting: Counting, settings: Settings, slots: Slots
):
    first = slots.start(settings, "a")
    await counting.submit(100, 0.05)
    await counting.until(lambda job: job.progress.step >= 20)
    child = psutil.Process(int(counting.starts()[0]["pid"]))
    slots.start(settings, "b")
    first.kill()
    await died(child)  # the job's process, with its worker
    job = await counting.until_final()
    assert (job.state, job.attempt) == ("succeeded", 2)
    starts = counting.starts()
    assert len(starts) == 2
    assert starts[1]["from"] >= 10, "resumed from the checkpoint"
    assert "requeued" in await counting.events()
    await counting.assert_one_result(100)


async def test_a_worker_started_again_under_the_same_name_takes_its_job_back_at_once(
    counting: Counting, settings: Settings, slots: Slots
):
    slow = settings.model_copy(update={"stall_s": 60.0, "beat_s": 10.0})
    first = slots.start(slow, "a")
    await counting.submit(40, 0.05)
    await counting.until(lambda job: job.progress.step >= 10)
    first.kill()
    first.wait()
    slots.start(slow, "a")
    job = await counting.until_final(timeout_s=20)  # a third of the stall time
    assert (job.state, job.attempt) == ("succeeded", 2)


async def test_kill_9_of_the_job_process_resumes_from_the_checkpoint(
    counting: Counting, settings: Settings, slots: Slots
):
    slots.start(settings, "a")
    await counting.submit(60, 0.03)
    await counting.until(lambda job: job.progress.step >= 20)
    os.kill(int(counting.starts()[0]["pid"]), signal.SIGKILL)
    job = await counting.until_final()
    assert (job.state, job.attempt) == ("succeeded", 2)
    assert counting.starts()[1]["from"] >= 10
    (crash,) = [
        e for e in (await counting.stores.jobs.update(counting.id)).events if e.type == "attempt_crashed"
    ]
    assert crash.data["how"] == "exit status -9"
    assert "counting from 0" in crash.data["log_tail"]
    await counting.assert_one_result(60)


async def test_a_job_that_always_dies_fails_after_its_attempts(
    counting: Counting, settings: Settings, slots: Slots
):
    slots.start(settings, "a")
    await counting.submit(10, 0.01, die_at=3)
    job = await counting.until_final()
    assert (job.state, job.attempt) == ("failed", settings.max_attempts)
    assert job.error is not None
    assert job.error.code == "too_many_crashes"
    assert "dying now" in job.error.log_tail
    assert "want of memory" in job.error.detail
    assert [item.name for item in await counting.stores.jobs.artifacts(counting.id)] == ["log.txt"]
    assert len(counting.starts()) == settings.max_attempts


async def test_crashes_count_only_until_the_next_checkpoint(
    counting: Counting, settings: Settings, slots: Slots
):
    slots.start(settings.model_copy(update={"max_attempts": 2}), "a")
    await counting.submit(40, 0.01, die_every=7)
    job = await counting.until_final()
    assert (job.state, job.attempt) == ("succeeded", 8)
    await counting.assert_one_result(40)


async def test_a_full_disk_costs_no_attempt_and_the_owner_sees_what_the_job_waits_for(
    counting: Counting, settings: Settings, slots: Slots, tmp_path: Path
):
    full = tmp_path / "full"
    full.touch()
    slots.start(settings.model_copy(update={"max_attempts": 1, **SHORT_STALL}), "a")
    await counting.submit(20, 0.01, no_room=str(full))
    waiting = await counting.until(lambda job: "disk is full" in job.message)
    assert waiting.state == "queued"
    full.unlink()
    job = await counting.until_final()
    assert (job.state, job.message) == ("succeeded", "")
    assert counting.starts()[-1]["from"] == 5, "and it went on from its checkpoint"


async def test_a_job_that_does_not_fit_on_the_disk_says_so(
    counting: Counting, settings: Settings, slots: Slots
):
    first = slots.start(settings.model_copy(update={"disk_reserve_bytes": 2**60, **SHORT_STALL}), "a")
    await counting.submit(20, 0.01)
    waiting = await counting.until(lambda job: "disk is full" in job.message)
    assert (waiting.state, waiting.attempt) == ("queued", 0)
    first.terminate()
    first.wait()
    slots.start(settings, "a")
    assert (await counting.until_final()).state == "succeeded"


@pytest.mark.skipif(shutil.which("gcc") is None, reason="no gcc")
async def test_a_worker_whose_clock_is_an_hour_ahead_gives_a_job_back_for_now(
    counting: Counting, settings: Settings, slots: Slots, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    clock = WrongClock(tmp_path)
    clock.jump(3600)
    with monkeypatch.context() as ahead:
        for name, value in clock.variables().items():
            ahead.setenv(name, value)
        full = settings.model_copy(update={"disk_reserve_bytes": 2**60, **SHORT_STALL})
        first = slots.start(full, "a")
    await counting.submit(20, 0.01)
    await counting.until(lambda job: "disk is full" in job.message)
    first.terminate()
    first.wait()
    slots.start(settings, "b")
    assert (await counting.until_final()).state == "succeeded"


async def test_a_job_that_kills_its_worker_each_time_fails_too(
    counting: Counting, settings: Settings, slots: Slots
):
    once = settings.model_copy(update={"max_attempts": 1})
    await counting.submit(100, 0.05, checkpoint_every=1000)
    for attempt in range(1, LOSSES_PER_CRASH + 1):
        slot = slots.start(once, "a")
        await counting.until(lambda job, n=attempt: job.state == "running" and job.attempt == n)
        slot.kill()
        slot.wait()
    slots.start(once, "a")
    job = await counting.until_final()
    assert job.error is not None
    assert job.attempt == LOSSES_PER_CRASH, "losing a worker is seldom the job's fault"
    assert (job.state, job.error.code) == ("failed", "too_many_crashes")
    assert "the worker was lost" in job.error.detail


async def test_a_mistake_of_the_user_is_not_tried_again(counting: Counting, settings: Settings, slots: Slots):
    slots.start(settings, "a")
    await counting.submit(10, 0.01, refuse=True)
    job = await counting.until_final()
    assert (job.state, job.attempt) == ("failed", 1)
    assert job.error is not None
    assert (job.error.code, job.error.where) == ("pose_file_invalid", "transforms.json")


async def test_a_checkpoint_that_cannot_be_used_is_dropped_and_the_job_starts_over(
    counting: Counting, settings: Settings, slots: Slots
):
    first = slots.start(settings, "a")
    await counting.submit(40, 0.03, outdated=True)
    await counting.until(lambda job: job.progress.step >= 10)
    first.terminate()
    await asyncio.to_thread(first.wait, 10)
    slots.start(settings, "a")
    job = await counting.until_final()
    assert job.state == "succeeded"
    assert [start["from"] for start in counting.starts()][::2] == [0, 0]


async def test_a_job_that_takes_too_long_ends_with_a_timeout(
    counting: Counting, settings: Settings, slots: Slots
):
    slots.start(settings.model_copy(update={"job_timeout_s": 1.0}), "a")
    await counting.submit(1000, 0.05)
    job = await counting.until_final()
    assert job.error is not None
    assert (job.state, job.error.code, job.attempt) == ("failed", "timeout", 1)


async def test_sigterm_gives_the_job_back_without_counting_the_attempt(
    counting: Counting, settings: Settings, slots: Slots
):
    first = slots.start(settings, "a")
    await counting.submit(60, 0.05, checkpoint_every=1000)
    await counting.until(lambda job: job.progress.step >= 10)
    first.terminate()
    assert await asyncio.to_thread(first.wait, 10) == 0
    job = await counting.stores.jobs.get(counting.id)
    assert (job.state, job.attempt) == ("queued", 0)
    slots.start(settings, "b")
    job = await counting.until_final()
    assert (job.state, job.attempt) == ("succeeded", 1)
    assert counting.starts()[1]["from"] >= 10, "the checkpoint written at SIGTERM was kept"
    await counting.assert_one_result(60)


@pytest.mark.parametrize("within_transaction", [False, True])
async def test_a_frozen_worker_that_wakes_up_is_fenced_and_one_result_is_published(
    counting: Counting, settings: Settings, slots: Slots, within_transaction: bool
):
    """Within a transaction it holds locks on the job or the janitor's office, which the database must end."""
    first = slots.start(settings, "a")
    await counting.submit(80, 0.05)
    await counting.until(lambda job: job.progress.step >= 10)
    slots.start(settings, "b")
    await _freeze(first.pid, counting.stores, within_transaction)
    await counting.until(lambda job: job.attempt == 2)
    os.kill(first.pid, signal.SIGCONT)
    assert await asyncio.to_thread(first.wait, 15) == 75
    job = await counting.until_final()
    assert (job.state, job.attempt) == ("succeeded", 2)
    await counting.assert_one_result(80)
    await _trash_is_empty(counting.stores)
    left = {
        file.key.split("/")[3] for file in await counting.stores.files.list(f"jobs/{counting.id}/results")
    }
    assert len(left) == 1, "what the loser wrote was collected"
    assert await counting.stores.files.list(f"jobs/{counting.id}/checkpoints") == []


async def _freeze(pid: int, stores: Stores, within_transaction: bool) -> None:
    """Stop the process at any moment, or in the middle of a transaction."""
    os.kill(pid, signal.SIGSTOP)
    while within_transaction:
        await asyncio.sleep(0.02)  # what was on its way to the database arrives
        held = await stores.jobs._database.fetch(
            "SELECT 1 FROM pg_stat_activity WHERE state = 'idle in transaction'"
        )
        if held:
            return
        os.kill(pid, signal.SIGCONT)
        await asyncio.sleep(0.003)
        os.kill(pid, signal.SIGSTOP)


async def _trash_is_empty(stores: Stores) -> None:
    for _ in range(100):
        if not await stores.jobs._database.fetch("SELECT 1 FROM trash"):
            return
        await asyncio.sleep(0.1)
    raise AssertionError("the trash was not taken out")


async def test_a_store_that_is_away_at_the_end_costs_no_attempt(
    counting: Counting, settings: Settings, slots: Slots
):
    """As where its disk is unmounted: what was computed is kept until it can be stored."""
    slots.start(settings, "a")
    await counting.submit(40, 0.05, checkpoint_every=1000)
    await counting.until(lambda job: job.progress.step >= 5)
    away = settings.files_dir.with_name("away")
    settings.files_dir.rename(away)
    settings.files_dir.touch()
    program = psutil.Process(int(counting.starts()[0]["pid"]))
    await asyncio.to_thread(psutil.wait_procs, [program], 20)
    await asyncio.sleep(1.0)
    assert (await counting.stores.jobs.get(counting.id)).state == "running"
    settings.files_dir.unlink()
    away.rename(settings.files_dir)
    job = await counting.until_final()
    assert (job.state, job.attempt, len(counting.starts())) == ("succeeded", 1, 1)
    await counting.assert_one_result(40)
