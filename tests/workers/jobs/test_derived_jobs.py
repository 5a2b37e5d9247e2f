"""Forks and exports of real jobs, run by the real program on a small scene."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import anyio
import pytest

from biresnerf.data.synthetic.scene import write_synthetic_scene
from biresnerf.options.refine_options import RefineOptions
from biresnerf.wire.jobs import JobView
from tests.workers.conftest import Counting, Slots, quick_settings, ready_dataset
from workers.engine import Stores, open_stores
from workers.jobs.derived_jobs import DerivedJobs, plan_fork
from workers.settings.errors import Conflict, LimitReached, NotFound

SMALL = RefineOptions(
    preset="fast", device="cpu", start="given", steps=60, coarse_steps_min=20, coarse_steps_max=30, check_every=10,
    max_image_size=24, samples_per_step=2048, pose_resolution_max=24, reconstruction_levels=2, table_size_log2=10,
    reconstruction_resolution_max=256, orbit_frames=0, verdict=False, threads=1,
)  # fmt: skip


async def over(stores: Stores, job: JobView, tmp_path: Path) -> JobView:
    watched = Counting(stores, tmp_path / "journal")
    watched.id = job.id
    done = await watched.until_final(timeout_s=300)
    assert done.state == "succeeded", done.error
    return done


async def read(stores: Stores, job_id: str, name: str) -> bytes:
    (found,) = [item for item in await stores.jobs.artifacts(job_id) if item.name == name]
    return b"".join([chunk async for chunk in stores.files.read(found.key)])


async def no_copy_is_made_for_a_fork_that_is_there_or_has_no_room(
    stores: Stores, derived: DerivedJobs, first: JobView, fork: JobView
) -> None:
    async def copies() -> set[str]:
        return {file.key.split("/")[1] for file in await stores.files.list("jobs") if "/taken/" in file.key}

    assert await copies() == {fork.id}
    again = await derived.fork(first.id, {"warmup_steps": 5}, labels={"n": "2"}, idempotency_key="fork")
    assert (again[0].id, again[1]) == (fork.id, False)
    await stores.tenants.set(first.tenant, max_stored_bytes=1)
    with pytest.raises(LimitReached):
        await derived.fork(first.id, {"warmup_steps": 6})
    await stores.tenants.set(first.tenant, max_stored_bytes=0)
    assert await copies() == {fork.id}


@pytest.mark.anyio
async def test_a_real_job_is_forked_and_exported(database_url: str, tmp_path: Path, slots: Slots):
    settings = quick_settings(
        tmp_path / "data",
        database_url=database_url,
        job_command=(sys.executable, "-m", "workers.run.job_process"),
    )
    slots.start(settings, "a")
    write_synthetic_scene(tmp_path / "scene", 6, 24, seed=3)
    files = {
        path.relative_to(tmp_path / "scene").as_posix(): path.read_bytes()
        for path in (tmp_path / "scene").rglob("*")
        if path.is_file()
    }
    async with open_stores(settings) as stores:
        derived = DerivedJobs(stores.jobs, stores.files)
        first, _ = await stores.jobs.submit(await ready_dataset(stores, files), SMALL, labels={"n": "1"})
        first = await over(stores, first, tmp_path)

        fork, _ = await derived.fork(first.id, {"warmup_steps": 5}, labels={"n": "2"}, idempotency_key="fork")
        await no_copy_is_made_for_a_fork_that_is_there_or_has_no_room(stores, derived, first, fork)
        assert (fork.forked_from, fork.forked_stage, fork.options["warmup_steps"]) == (first.id, "coarse", 5)
        export, new = await derived.export(first.id, ["pinhole", "kitti"])
        assert (new, export.kind, export.parent) == (True, "export", first.id)
        same, new = await derived.export(first.id, ["kitti", "pinhole"])
        assert (new, same.id) == (False, export.id)
        of_body, new = await derived.export(first.id, ["kitti"], "body")
        assert (new, of_body.options) == (True, {"formats": ["kitti"], "poses_of": "body"})
        await over(stores, fork, tmp_path)
        stages = [e.data["stage"] for e in (await stores.jobs.update(fork.id)).events if e.type == "stage"]
        assert "fine" in stages
        assert "coarse" not in stages
        reports = [json.loads(await read(stores, job.id, "report.json")) for job in (first, fork)]
        assert reports[0]["switch_step"] == reports[1]["switch_step"]

        await over(stores, export, tmp_path)
        names = {item.name for item in await stores.jobs.artifacts(first.id)}
        assert {"kitti.txt", "pinhole/sparse/0/images.bin", "pinhole/images/r_0.png", "poses.json"} <= names
        assert len((await read(stores, first.id, "kitti.txt")).splitlines()) == 6
        while not (refused := await stores.jobs.get(of_body.id)).final:
            await anyio.sleep(0.1)
        assert refused.error is not None
        assert "no offset between these cameras and a body" in refused.error.detail
        assert [job.id for job in (await stores.jobs.list()).items] == [fork.id, first.id]

        with pytest.raises(Conflict) as caught:
            await derived.fork(first.id, {"steps": 80})
        assert caught.value.code == "fork_not_possible"
        assert "Stage 1 depends on" in caught.value.detail
        await stores.jobs.delete(first.id)
        with pytest.raises(NotFound):
            await stores.jobs.get(export.id)
        assert await read(stores, fork.id, "poses.json")


PARENT = {
    "options": SMALL.model_dump(mode="json", exclude_unset=True),
    "resolved_options": SMALL.resolved("cpu").model_dump(mode="json"),
    "smaller": {},
    "reusable": {"seeding": {}, "coarse": {}},
}
SEEDED = {**PARENT, "options": {**PARENT["options"], "start": "auto"}}


@pytest.mark.parametrize(
    ("changes", "stage"),
    [
        ({}, "coarse"),
        ({"table_size_log2": 12, "verdict": True}, "coarse"),
        ({"max_image_size": 32}, "seeding"),
        ({"start": "colmap"}, "seeding"),
    ],
)
def test_the_latest_stage_that_the_options_allow_is_taken_over(changes: dict[str, object], stage: str):
    options, taken = plan_fork(SEEDED, changes, "auto")
    assert taken == stage
    assert options.model_dump(exclude_unset=True) == {
        **SMALL.model_dump(exclude_unset=True),
        "start": "auto",
        **changes,
    }


@pytest.mark.parametrize(
    ("parent", "changes", "wanted", "reason"),
    [
        (SEEDED, {"seed": 1}, "auto", "Stage 1 depends on seed. COLMAP's answer depends on seed."),
        (SEEDED, {"start": "given"}, "seeding", "start=given does not ask COLMAP."),
        (SEEDED, {"max_image_size": 32}, "coarse", "Stage 1 depends on max_image_size."),
        ({**SEEDED, "reusable": {}}, {}, "coarse", "The job has not come to the end of stage 1."),
        ({**SEEDED, "reusable": {}}, {}, "seeding", "The job has no poses from COLMAP."),
    ],
)
def test_a_fork_that_could_take_nothing_over_is_refused_with_the_reason(
    parent: dict[str, object], changes: dict[str, object], wanted: str, reason: str
):
    with pytest.raises(Conflict) as caught:
        plan_fork(parent, changes, wanted)
    assert caught.value.detail == reason


def test_a_fork_of_a_job_that_ran_on_a_gpu_is_compared_with_what_a_gpu_takes():
    asked = RefineOptions(preset="fast")
    resolved = asked.resolved("cuda").model_dump(mode="json")
    # Where matches placed the cameras, stage 1 was shorter than it would have been otherwise.
    ran = {**PARENT, "options": {"preset": "fast"}, "resolved_options": {**resolved, "coarse_steps_max": 800}}
    assert plan_fork(ran, {"max_image_size": resolved["max_image_size"]}, "auto")[1] == "coarse"
    assert plan_fork(ran, {"device": "cuda"}, "auto")[1] == "coarse"
    for change in ({"max_image_size": asked.resolved("cpu").max_image_size}, {"device": "cpu"}):
        assert plan_fork(ran, change, "auto")[1] == "seeding"


def test_a_fork_of_a_job_that_ran_out_of_memory_asks_for_as_little_as_its_second_try():
    smaller = {"max_image_size": 20}
    options, stage = plan_fork({**SEEDED, "smaller": smaller}, {"warmup_steps": 5}, "auto")
    assert (options.max_image_size, stage) == (20, "coarse")
