"""Exports run beside the refinement that holds the slot, and are as safe as it is."""

from __future__ import annotations

import asyncio
import sys
from pathlib import Path

import pytest
from psycopg.types.json import Jsonb

from tests.workers.conftest import PROGRAM, SHORT_STALL, Counting, Slots, quick_settings
from tests.workers.queue.test_one_job import OneJob, status
from workers.database import job_queue
from workers.database.database import Connection
from workers.jobs.job_states import insert_job, queue_job
from workers.process.exit_status import ExitStatus
from workers.settings.settings import Settings

pytestmark = pytest.mark.anyio
# Exports write down their attempts, and last for as long as there is a file "wait". All else counts.
EXPORTS = """
import json, pathlib, runpy, signal, sys, time
folder, notes = pathlib.Path(sys.argv[-1]), pathlib.Path({notes!r})
order = json.loads((folder / "job.json").read_text())
if order.get("task") != "export":
    runpy.run_path({counting!r}, run_name="__main__")
    sys.exit()
signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))
with (notes / "begun").open("a") as begun:
    begun.write("x")
while (notes / "wait").exists():
    time.sleep(0.05)
(folder / order["output"] / "kitti.txt").write_text("exported")
"""


@pytest.fixture
def settings(database_url: str, tmp_path: Path) -> Settings:
    program = EXPORTS.format(notes=str(tmp_path), counting=str(PROGRAM))
    command = (sys.executable, "-c", program)
    return quick_settings(tmp_path / "data", database_url=database_url, job_command=command, **SHORT_STALL)


@pytest.fixture
def one_job(settings: Settings, slots: Slots, tmp_path: Path) -> OneJob:
    return OneJob(settings, slots, tmp_path)


async def submit_export(counting: Counting, number: int = 0) -> Counting:
    """An export of the job."""
    parent = await counting.stores.jobs.get(counting.id)
    export = Counting(counting.stores, counting._journal)
    export.id = f"exp_{number}"
    values = {
        **{"id": export.id, "kind": "export", "parent": parent.id, "dataset_id": parent.dataset_id},
        **{"options": Jsonb({"formats": ["kitti"]}), "fingerprint": str(number)},
    }

    async def add(connection: Connection) -> None:
        await queue_job(connection, await insert_job(connection, values))

    await counting.stores.jobs._database.run(add)
    return export


async def published_once(counting: Counting) -> None:
    assert (await counting.events()).count("succeeded") == 1
    assert (await counting.result())["steps"] == 60


async def begun(folder: Path, times: int) -> None:
    async with asyncio.timeout(60):
        while not (folder / "begun").exists() or len((folder / "begun").read_text()) < times:
            await asyncio.sleep(0.05)


async def test_a_worker_for_one_job_exports_beside_it_whatever_the_tenants_limit(
    counting: Counting, one_job: OneJob
):
    await counting.stores.tenants.set("local", max_running=1)
    process = one_job.start()
    await counting.submit(60, 0.05)
    await counting.until(lambda job: job.progress.step >= 2)
    for number in range(3):
        export = await submit_export(counting, number)
        assert (await export.until_final()).state == "succeeded"
    assert (await counting.stores.jobs.get(counting.id)).state == "running"
    assert await status(process) == ExitStatus.DONE
    await published_once(counting)


async def test_an_export_is_a_job_for_such_a_worker_too(counting: Counting, one_job: OneJob):
    await counting.submit(3, 0.01)
    assert await status(one_job.start()) == ExitStatus.DONE
    export = await submit_export(counting)
    assert await status(one_job.start("--idle-exit", "0")) == ExitStatus.DONE
    assert (await counting.stores.jobs.get(export.id)).state == "succeeded"


async def test_it_ends_after_the_export_that_it_is_at(counting: Counting, one_job: OneJob, tmp_path: Path):
    process = one_job.start()
    await counting.submit(20, 0.05)
    await counting.until(lambda job: job.progress.step >= 2)
    (tmp_path / "wait").touch()
    export = await submit_export(counting)
    await begun(tmp_path, 1)
    later = await submit_export(counting, 1)
    assert (await counting.until_final()).state == "succeeded"
    assert process.poll() is None
    (tmp_path / "wait").unlink()
    assert await status(process) == ExitStatus.DONE
    states = [(await counting.stores.jobs.get(job.id)).state for job in (export, later)]
    assert states == ["succeeded", "queued"]


@pytest.mark.parametrize("how", ["terminate", "kill"])
async def test_both_jobs_of_a_slot_that_ends_go_on_elsewhere(
    counting: Counting, slots: Slots, settings: Settings, tmp_path: Path, how: str
):
    (tmp_path / "wait").touch()
    first = slots.start(settings, "a")
    await counting.submit(60, 0.05)
    await counting.until(lambda job: job.progress.step >= 10)
    export = await submit_export(counting)
    await begun(tmp_path, 1)
    getattr(first, how)()
    await asyncio.to_thread(first.wait, 30)
    if how == "terminate":
        for job in (counting, export):
            view = await counting.stores.jobs.get(job.id)
            assert (view.state, view.attempt) == ("queued", 0)
    slots.start(settings, "b")
    await begun(tmp_path, 2)
    (tmp_path / "wait").unlink()
    done = await export.until_final()
    assert (done.state, done.attempt) == ("succeeded", 1 if how == "terminate" else 2)
    assert (await counting.until_final()).state == "succeeded"
    assert counting.starts()[1]["from"] >= 5, "resumed from a checkpoint"
    await published_once(counting)


async def test_a_slot_that_asks_again_gets_the_entry_of_its_lane(counting: Counting):
    """An answer may be lost with its connection; the other lane's entry is not the lost one."""
    run = counting.stores.jobs._database.run
    await counting.submit(1, 0.0)
    export = await submit_export(counting)
    worker = await run(job_queue.register_worker)
    for job, kind in 2 * [(counting.id, job_queue.REFINEMENTS), (export.id, job_queue.EXPORTS)]:
        entry = await run(lambda connection, kind=kind: job_queue.take(connection, worker, [kind]))
        assert entry is not None
        assert entry.job_id == job
