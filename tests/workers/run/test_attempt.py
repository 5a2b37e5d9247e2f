"""A job between its start and its end: previews, a partial result, its log, less memory."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import psutil
import pytest

from biresnerf.options.refine_options import RefineOptions
from tests.workers.conftest import Counting, Slots, claimed, taken_by_somebody
from workers.engine import Stores
from workers.jobs.ledger import Ledger
from workers.records import Artifact
from workers.run.attempt import Attempt, OomKills, smaller_options
from workers.settings.settings import Settings

pytestmark = pytest.mark.anyio


async def content(stores: Stores, artifact: Artifact) -> dict[str, object]:
    return json.loads(b"".join([chunk async for chunk in stores.files.read(artifact.key)]))


async def named(counting: Counting) -> dict[str, Artifact]:
    return {item.name: item for item in await counting.stores.jobs.artifacts(counting.id)}


async def until_previewed(counting: Counting, step: int) -> None:
    async for update in counting.stores.jobs.subscribe(counting.id):
        if update and any(e.type == "preview" and e.data["step"] >= step for e in update.events):
            return


async def test_a_running_job_shows_previews_and_its_result_takes_their_place(
    counting: Counting, settings: Settings, slots: Slots
):
    slots.start(settings, "a")
    await counting.submit(60, 0.03, preview_every=10)
    await until_previewed(counting, 20)
    shown = await named(counting)
    assert set(shown) == {"preview/poses.json", "preview/report.json"}, "and nothing from outside the folder"
    assert all(item.preview for item in shown.values())
    poses = await content(counting.stores, shown["preview/poses.json"])
    assert poses["step"] >= 20
    assert (await counting.until_final()).state == "succeeded"
    assert set(await named(counting)) == {"log.txt", "report.json", "renders/one.png"}
    garbage = await counting.stores.jobs._database.fetch("SELECT prefix FROM trash")
    assert f"jobs/{counting.id}/previews" in {row["prefix"] for row in garbage}


@pytest.mark.parametrize("fault", [None, "deaf", "slow_to_end"])
async def test_a_cancelled_job_leaves_its_best_poses_if_asked(
    counting: Counting, settings: Settings, slots: Slots, fault: str | None
):
    """From the process itself, or its last preview where it is killed before all is written."""
    slots.start(settings.model_copy(update={"cancel_grace_s": 0.5}), "a")
    await counting.submit(1000, 0.05, preview_every=5, **({fault: True} if fault else {}))
    await until_previewed(counting, 5)
    await counting.stores.jobs.cancel(counting.id, keep_partial=True)
    job = await counting.until_final(timeout_s=10)
    assert (job.state, job.partial) == ("cancelled", True)
    left = await named(counting)
    assert set(left) == {"log.txt", "poses.json", "report.json"}
    report = await content(counting.stores, left["report.json"])
    assert report["state"] == "partial"
    assert ("previews" in left["poses.json"].key) == (fault is not None)
    assert await counting.nobodys_files() == []
    for _ in range(3):  # what is kept is not collected with the rest
        assert (await content(counting.stores, left["poses.json"]))["step"] >= 5


async def test_a_partial_result_is_left_even_where_the_worker_has_died(
    counting: Counting, settings: Settings, slots: Slots
):
    first = slots.start(settings, "a")
    await counting.submit(1000, 0.05, preview_every=5)
    await until_previewed(counting, 5)
    first.kill()
    first.wait()
    await counting.stores.jobs.cancel(counting.id, keep_partial=True)
    slots.start(settings, "b")
    job = await counting.until_final()
    assert (job.state, job.partial) == ("cancelled", True)
    assert {"poses.json", "report.json"} <= set(await named(counting))


async def test_a_cancelled_job_whose_result_nobody_wants_leaves_its_log_alone(
    counting: Counting, settings: Settings, slots: Slots
):
    slots.start(settings, "a")
    await counting.submit(1000, 0.05, preview_every=5)
    await until_previewed(counting, 5)
    await counting.stores.jobs.cancel(counting.id)
    job = await counting.until_final(timeout_s=10)
    assert (job.state, job.partial) == ("cancelled", False)
    assert set(await named(counting)) == {"log.txt"}
    assert await counting.nobodys_files() == []
    assert not psutil.pid_exists(int(counting.starts()[0]["pid"]))


@pytest.mark.parametrize("wanted", [True, False])
async def test_of_a_result_that_was_stored_when_its_job_was_cancelled_only_what_is_wanted_stays(
    counting: Counting, settings: Settings, tmp_path: Path, wanted: bool
):
    """Otherwise its files would be nobody's, and stay as long as the job."""
    stores = counting.stores
    await counting.submit(1, 0.0, poses=True)
    await taken_by_somebody(stores.jobs._database)
    claim = await claimed(stores.jobs._database, counting.id)
    assert claim is not None

    class CancelledAtTheEnd(Ledger):
        async def publish(self, *given: object) -> bool:
            await stores.jobs.cancel(counting.id, keep_partial=wanted)
            return await super().publish(*given)

    attempt = Attempt(stores.jobs._database, stores.files, settings, claim, tmp_path / "work", {})
    attempt._ledger = CancelledAtTheEnd(stores.jobs._database, claim, settings.stall_s)
    assert (await attempt.run()).how == "cancelled"
    job = await stores.jobs.get(counting.id)
    assert (job.state, job.partial) == ("cancelled", wanted)
    assert set(await named(counting)) == (
        {"log.txt", "poses.json", "renders/one.png", "report.json"} if wanted else {"log.txt"}
    )
    assert await counting.nobodys_files() == []


async def test_the_log_can_be_followed_line_by_line(counting: Counting, settings: Settings, slots: Slots):
    slots.start(settings, "a")
    await counting.submit(30, 0.05, die_at=15)
    while not (lines := await counting.stores.jobs.log(counting.id)):
        await counting.until(lambda job: job.state == "running")
    assert lines[0].text == "counting from 0"
    await counting.until_final()
    lines = await counting.stores.jobs.log(counting.id)
    assert [line.n for line in lines] == list(range(1, len(lines) + 1))
    assert [line.text for line in lines if line.attempt == 1][-1] == "dying now"
    assert {line.attempt for line in lines} == {1, 2}
    assert await counting.stores.jobs.log(counting.id, after=lines[1].n, limit=1) == lines[2:3]


async def test_a_job_without_memory_is_tried_once_more_with_less(
    counting: Counting, settings: Settings, slots: Slots
):
    slots.start(settings, "a")
    await counting.submit(10, 0.02, hungry=100)
    job = await counting.until_final()
    assert (job.state, job.attempt) == ("succeeded", 2)
    assert (job.resolved_options["max_image_size"], job.smaller["max_image_size"]) == (64, 64)
    (again,) = [
        e for e in (await counting.stores.jobs.update(counting.id)).events if e.type == "retried_smaller"
    ]
    assert again.data["options"] == job.smaller
    await counting.submit(10, 0.02, hungry=10)
    job = await counting.until_final()
    assert job.error is not None
    assert (job.state, job.attempt, job.error.code) == ("failed", 2, "out_of_memory")
    assert "max_image_size" in job.error.hint


async def test_what_a_gpu_worker_runs_is_what_the_job_shows_and_what_a_second_try_has_less_of(
    counting: Counting, settings: Settings, slots: Slots
):
    slots.start(settings, "a")
    await counting.submit(10, 0.02, device="cuda", hungry=200)
    job = await counting.until_final()
    assert (job.state, job.attempt) == ("succeeded", 2)
    assert job.smaller["max_image_size"] == 128, "half of the 256 px that a GPU takes"
    assert job.resolved_options["max_image_size"] == 128
    assert job.resolved_options["device"] == "cuda"
    assert "max_image_size" not in job.options


async def test_a_process_killed_while_the_kernel_counts_a_kill_ran_out_of_memory(
    counting: Counting, settings: Settings, slots: Slots, tmp_path: Path
):
    """The kernel cannot be made to kill here, so its counter is a file that the dying process raises."""
    counter = tmp_path / "vmstat"
    counter.write_text("oom_kill 4\n")
    program = (
        "import workers.run.attempt as memory, workers.queue.slot as slot, sys, pathlib;"
        f"here = pathlib.Path({str(tmp_path)!r});"
        "real = memory.OomKills.__init__;"
        "memory.OomKills.__init__ = lambda self: real(self, here, here);"
        "sys.exit(slot.run_slot('a'))"
    )
    slots.run(settings, [sys.executable, "-c", program], tmp_path / "slot.log")
    await counting.submit(10, 0.02, die_at=3, oom_counter=str(counter))
    job = await counting.until_final()
    assert job.error is not None
    assert (job.state, job.attempt, job.error.code) == ("failed", 2, "out_of_memory")


def test_the_kernels_count_is_read_from_the_innermost_group(tmp_path: Path):
    proc, groups = tmp_path / "proc", tmp_path / "groups"
    (proc / "self").mkdir(parents=True)
    (proc / "vmstat").write_text("pgfault 12\noom_kill 7\n")
    assert OomKills(proc, groups).count() == 7
    (proc / "self" / "cgroup").write_text("4:cpu:/\n3:memory,x:/jobs/a\n0::/unit\n")
    old = groups / "memory" / "jobs" / "a"
    old.mkdir(parents=True)
    (old / "memory.oom_control").write_text("oom_kill_disable 0\nunder_oom 0\noom_kill 2\n")
    assert OomKills(proc, groups).count() == 2
    (groups / "memory.events").write_text("low 0\noom 3\noom_kill 3\noom_group_kill 0\n")
    (proc / "self" / "cgroup").write_text("0::/unit\n")
    assert OomKills(proc, groups).count() == 3
    assert OomKills(tmp_path / "none", groups).count() is None


def test_a_second_try_asks_for_less_but_never_for_too_little():
    quality = RefineOptions(preset="quality", seeding_effort="low").resolved("cpu")
    assert smaller_options(quality) == {
        "samples_per_step": 2**15, "max_image_size": 200, "table_size_log2": 17,
    }  # fmt: skip
    for side in (64, 32):
        sizes = {"samples_per_step": 1024, "max_image_size": side, "table_size_log2": 10}
        least = RefineOptions(**sizes, seeding_effort="low").resolved("cpu")
        assert smaller_options(least) == {}
        full = least.model_copy(update={"seeding_effort": "full"})
        assert smaller_options(full) == {"seeding_effort": "low"}
