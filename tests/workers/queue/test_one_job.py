"""A worker for one job, as autoscalers and batch systems start it: each end of a job has an exit status of its own."""

from __future__ import annotations

import asyncio
import re
import subprocess
import sys
import time
from pathlib import Path

import pytest

from tests.workers.conftest import SHORT_STALL, Counting, Slots
from workers.process.exit_status import ExitStatus
from workers.settings.settings import Settings

pytestmark = pytest.mark.anyio
OPERATIONS = Path(__file__).parents[3] / "docs/operations.md"


class OneJob:
    """Starts `biresnerf worker --one-job`."""

    def __init__(self, settings: Settings, slots: Slots, folder: Path) -> None:
        self.settings, self._slots, self._folder = settings, slots, folder

    def start(
        self, *words: str, slot: str | None = "a", kind: str = "cpu", **changes: object
    ) -> subprocess.Popen[bytes]:
        named = ["--free-slot", kind] if slot is None else ["--slot", slot]
        command = [sys.executable, "-m", "biresnerf.command_line", "worker", *named, "--one-job"]
        settings = self.settings.model_copy(update=changes)
        return self._slots.run(settings, [*command, *words], self._folder / f"one-{slot}.log")


@pytest.fixture
def one_job(settings: Settings, slots: Slots, tmp_path: Path) -> OneJob:
    return OneJob(settings, slots, tmp_path)


async def status(process: subprocess.Popen[bytes]) -> ExitStatus:
    return ExitStatus(await asyncio.to_thread(process.wait, 60))


async def test_it_takes_one_job_of_two(counting: Counting, one_job: OneJob):
    first = await counting.submit(8, 0.01)
    second = await counting.submit(8, 0.01)
    assert await status(one_job.start()) == ExitStatus.DONE
    states = {(await counting.stores.jobs.get(job)).state for job in (first, second)}
    assert states == {"succeeded", "queued"}
    assert await status(one_job.start("--idle-exit", "0")) == ExitStatus.DONE
    assert (await counting.stores.jobs.get(second)).state == "succeeded"
    await counting.assert_one_result(8)


async def test_it_waits_for_a_job_and_no_longer_than_it_may(counting: Counting, one_job: OneJob):
    begun = time.monotonic()
    assert await status(one_job.start("--idle-exit", "1.5")) == ExitStatus.NO_JOB
    assert time.monotonic() - begun >= 1.5
    waiting = one_job.start()
    await asyncio.sleep(1.5)
    assert waiting.poll() is None
    await counting.submit(3, 0.01)
    assert await status(waiting) == ExitStatus.DONE


async def test_an_idle_one_that_is_stopped_had_no_job(counting: Counting, one_job: OneJob):
    process = one_job.start()
    await _slots_seen(counting, 1)
    process.terminate()
    assert await status(process) == ExitStatus.NO_JOB


async def test_sigterm_in_mid_job_leaves_a_checkpoint_and_the_job_in_the_queue(
    counting: Counting, one_job: OneJob
):
    process = one_job.start()
    await counting.submit(60, 0.05, checkpoint_every=1000)
    await counting.until(lambda job: job.progress.step >= 10)
    process.terminate()
    assert await status(process) == ExitStatus.STOPPED
    job = await counting.stores.jobs.get(counting.id)
    assert (job.state, job.attempt) == ("queued", 0)
    assert await status(one_job.start("--idle-exit", "0", slot="b")) == ExitStatus.DONE
    assert counting.starts()[1]["from"] >= 10, "resumed from the checkpoint written at SIGTERM"
    job = await counting.stores.jobs.get(counting.id)
    assert (job.state, job.attempt) == ("succeeded", 1)
    await counting.assert_one_result(60)


async def test_free_slots_have_the_first_names_that_nobody_holds(
    counting: Counting, one_job: OneJob, settings: Settings
):
    names = settings.data_dir / "slots"
    workers = [one_job.start(slot=None) for _ in range(3)]
    await _slots_seen(counting, 3)
    for process in workers:
        process.terminate()
        assert await status(process) == ExitStatus.NO_JOB
    assert {path.name.rpartition(".")[2] for path in names.iterdir()} == {"cpu0", "cpu1", "cpu2"}
    assert await status(one_job.start("--idle-exit", "0", slot=None)) == ExitStatus.NO_JOB
    assert len(list(names.iterdir())) == 3


@pytest.mark.parametrize(("given", "expected"), [({"CUDA_VISIBLE_DEVICES": "3"}, "3"), ({}, "0")])
async def test_a_job_of_a_free_gpu_slot_gets_the_device_that_the_worker_was_given(
    counting: Counting, one_job: OneJob, monkeypatch: pytest.MonkeyPatch, given: dict[str, str], expected: str
):
    monkeypatch.delenv("CUDA_VISIBLE_DEVICES", raising=False)
    for name, value in given.items():
        monkeypatch.setenv(name, value)
    await counting.submit(3, 0.01)
    assert await status(one_job.start(slot=None, kind="gpu")) == ExitStatus.DONE
    assert counting.starts()[0]["device"] == expected


async def test_a_job_that_fails_or_is_cancelled_says_so(counting: Counting, one_job: OneJob):
    await counting.submit(10, 0.01, refuse=True)
    assert await status(one_job.start()) == ExitStatus.JOB_FAILED
    process = one_job.start()
    await counting.submit(1000, 0.05)
    await counting.until(lambda job: job.progress.step >= 2)
    await counting.stores.jobs.cancel(counting.id)
    assert await status(process) == ExitStatus.JOB_CANCELLED
    assert (await counting.stores.jobs.get(counting.id)).state == "cancelled"


async def test_an_attempt_that_crashes_is_given_back_and_the_last_one_fails(
    counting: Counting, one_job: OneJob
):
    await counting.submit(10, 0.01, die_at=3)
    assert await status(one_job.start(max_attempts=2)) == ExitStatus.GIVEN_BACK
    assert (await counting.stores.jobs.get(counting.id)).state == "queued"
    assert await status(one_job.start(max_attempts=2)) == ExitStatus.JOB_FAILED


async def test_a_job_for_which_there_is_no_room_is_given_back(counting: Counting, one_job: OneJob):
    await counting.submit(10, 0.01)
    full = one_job.start(disk_reserve_bytes=2**60, **SHORT_STALL)
    assert await status(full) == ExitStatus.GIVEN_BACK


async def test_the_table_in_the_docs_is_complete():
    rows = re.findall(r"^\| (\d+) \| (.+?) \|", OPERATIONS.read_text(), re.MULTILINE)
    assert [int(number) for number, _ in rows] == sorted(ExitStatus)


async def _slots_seen(counting: Counting, number: int) -> None:
    for _ in range(300):
        if len(await counting.stores.jobs._database.fetch("SELECT 1 FROM slots")) == number:
            await asyncio.sleep(0.2)  # its signal handlers follow
            return
        await asyncio.sleep(0.1)
    raise AssertionError("the worker did not register")
