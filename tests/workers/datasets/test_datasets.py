"""Datasets: files in, limits, checking, deleting."""

from __future__ import annotations

import asyncio
import hashlib
import sys
from collections.abc import AsyncIterator
from pathlib import Path

import pytest

from biresnerf.errors import InputError
from biresnerf.options.refine_options import RefineOptions
from biresnerf.wire.datasets import DatasetView, ManifestEntry
from tests.workers.conftest import ACCEPTED, SHORT_STALL, quick_settings, ready_dataset
from workers.engine import Stores, open_stores
from workers.process.disk_space import EXIT_DISK
from workers.settings.errors import Conflict, LimitReached, NotFound
from workers.settings.settings import Settings

pytestmark = pytest.mark.anyio


async def chunks(*parts: bytes) -> AsyncIterator[bytes]:
    for part in parts:
        yield part


async def content(stores: Stores, key: str) -> bytes:
    return b"".join([chunk async for chunk in stores.files.read(key)])


async def test_a_file_comes_back_as_it_was_sent(stores: Stores):
    dataset = await stores.datasets.create("fox")
    file, new = await stores.datasets.add_file(dataset.id, "images/ä 1.png", chunks(b"ab", b"c"))
    assert new
    assert (file.size, file.sha256) == (3, hashlib.sha256(b"abc").hexdigest())
    assert await content(stores, file.key) == b"abc"
    seen = await stores.datasets.get(dataset.id)
    assert (seen.state, seen.files, seen.bytes) == ("open", 1, 3)
    assert (await stores.datasets.files(dataset.id)).items == (file,)
    assert await stores.datasets.file(dataset.id, "images/ä 1.png") == file


async def test_a_file_sent_again_replaces_the_old_one_or_is_refused(stores: Stores):
    dataset = await stores.datasets.create("fox")
    await stores.datasets.add_file(dataset.id, "a", chunks(b"old"))
    file, new = await stores.datasets.add_file(dataset.id, "a", chunks(b"newer"))
    assert not new
    assert await content(stores, file.key) == b"newer"
    assert (await stores.datasets.get(dataset.id)).bytes == 5
    with pytest.raises(Conflict) as caught:
        await stores.datasets.add_file(dataset.id, "a", chunks(b"third"), overwrite=False)
    assert caught.value.code == "file_exists"


async def test_a_failed_upload_leaves_the_older_file_and_no_rubbish(stores: Stores, settings: Settings):
    dataset = await stores.datasets.create("fox")
    kept, _ = await stores.datasets.add_file(dataset.id, "a", chunks(b"old"))
    with pytest.raises(InputError) as caught:
        await stores.datasets.add_file(dataset.id, "a", chunks(b"torn"), sha256="0" * 64)
    assert caught.value.code == "digest_mismatch"

    async def breaks() -> AsyncIterator[bytes]:
        yield b"x" * 2**20
        raise ConnectionError("the client is gone")

    with pytest.raises(ConnectionError):
        await stores.datasets.add_file(dataset.id, "b", breaks())
    assert [file.key for file in await stores.files.list(f"datasets/{dataset.id}")] == [kept.key]
    assert await content(stores, kept.key) == b"old"
    on_disk = [path for path in (settings.files_dir / "datasets" / dataset.id).rglob("*") if path.is_file()]
    assert len(on_disk) == 1


@pytest.mark.parametrize(
    "path", ["", "/etc/passwd", "../x", "a/../b", "a//b", "a/.", "x#12", "n\0l", "y" * 256]
)
async def test_a_path_that_could_leave_the_dataset_is_refused(stores: Stores, path: str):
    dataset = await stores.datasets.create("fox")
    with pytest.raises(InputError) as caught:
        await stores.datasets.add_file(dataset.id, path, chunks(b"x"))
    assert caught.value.code == "unsafe_path"


async def test_limits_hold_while_the_bytes_arrive(database_url: str, tmp_path):
    small = quick_settings(
        tmp_path / "data", database_url=database_url, max_file_bytes=10, max_dataset_bytes=15, max_files=2
    )
    async with open_stores(small) as stores:
        dataset = await stores.datasets.create("fox")
        with pytest.raises(LimitReached) as caught:
            await stores.datasets.add_file(dataset.id, "a", chunks(b"x" * 6, b"x" * 5))
        assert caught.value.code == "body_too_large"
        await stores.datasets.add_file(dataset.id, "a", chunks(b"x" * 10))
        with pytest.raises(LimitReached):
            await stores.datasets.add_file(dataset.id, "b", chunks(b"x" * 6))
        await stores.datasets.add_file(dataset.id, "b", chunks(b"x" * 5))
        with pytest.raises(LimitReached) as caught:
            await stores.datasets.add_file(dataset.id, "c", chunks(b""))
        assert caught.value.code == "too_many_files"
        await stores.datasets.add_file(dataset.id, "a", chunks(b"y" * 10))


async def test_a_dataset_is_complete_when_its_manifest_is(stores: Stores):
    dataset = await stores.datasets.create("fox", [ManifestEntry(path="a"), ManifestEntry(path="b")])
    assert dataset.missing == ("a", "b")
    await stores.datasets.add_file(dataset.id, "b", chunks(b"x"))
    with pytest.raises(Conflict) as caught:
        await stores.datasets.finalize(dataset.id)
    assert caught.value.code == "dataset_not_complete"
    await stores.datasets.add_file(dataset.id, "a", chunks(b"x"))
    assert (await stores.datasets.finalize(dataset.id)).state == "finalizing"
    with pytest.raises(Conflict) as caught:
        await stores.datasets.add_file(dataset.id, "c", chunks(b"x"))
    assert caught.value.code == "dataset_not_open"
    assert await stores.datasets.unfinished() == (dataset.id,)
    assert (await stores.datasets.check(dataset.id)).state == "ready"
    assert (await stores.datasets.finalize(dataset.id)).state == "ready"


REJECTS = """
import json, sys
print(json.dumps({"error": {"code": "not_an_image", "detail": "is empty."}}))
sys.exit(2)
"""
CHECKERS = {
    "rejects": (REJECTS, "not_an_image"),
    "crashes": ("import os; os.abort()", "check_crashed"),
    "says_nonsense": ("print('hello')", "check_crashed"),
    "takes_too_long": ("import time; time.sleep(60)", "check_timeout"),
}


@pytest.mark.parametrize("name", CHECKERS)
async def test_a_check_that_does_not_pass_rejects_the_dataset(database_url: str, tmp_path, name: str):
    program, code = CHECKERS[name]
    settings = quick_settings(
        tmp_path / "data",
        database_url=database_url,
        check_command=(sys.executable, "-c", program),
        check_timeout_s=1.0,
    )
    async with open_stores(settings) as stores:
        dataset = await stores.datasets.create("fox")
        await stores.datasets.add_file(dataset.id, "a", chunks(b"x"))
        await stores.datasets.finalize(dataset.id)
        checked = await stores.datasets.check(dataset.id)
        assert checked.error is not None
        assert (checked.state, checked.error.code) == ("rejected", code)
    assert list((settings.scratch_dir / "checks").iterdir()) == []


async def test_a_check_that_found_the_disk_full_is_made_again(database_url: str, tmp_path):
    mark = tmp_path / "mark"
    full_once = f"mark = pathlib.Path({str(mark)!r}); mark.exists() or (mark.touch(), sys.exit({EXIT_DISK}))"
    program = f"import pathlib, sys; {full_once}; {ACCEPTED}"
    async with open_stores(checked_by(program, database_url, tmp_path)) as stores:
        dataset = await stores.datasets.create("fox")
        await stores.datasets.add_file(dataset.id, "a", chunks(b"x"))
        await stores.datasets.finalize(dataset.id)
        with pytest.raises(OSError, match="no room"):
            await stores.datasets.check(dataset.id)
        assert (await stores.datasets.get(dataset.id)).state == "finalizing"
        assert (await stores.datasets.check(dataset.id)).state == "ready"


async def test_two_checks_at_once_run_the_program_once(database_url: str, tmp_path):
    marks = tmp_path / "marks"
    program = f"open({str(marks)!r}, 'a').write('x'); import time; time.sleep(0.3); {ACCEPTED}"
    settings = checked_by(program, database_url, tmp_path)
    async with open_stores(settings) as one, open_stores(settings) as other:
        dataset = await one.datasets.create("fox")
        await one.datasets.add_file(dataset.id, "a", chunks(b"x"))
        await one.datasets.finalize(dataset.id)
        checked = await asyncio.gather(one.datasets.check(dataset.id), other.datasets.check(dataset.id))
    assert {item.state for item in checked} == {"ready"}
    assert marks.read_text() == "x"


async def test_many_checks_of_one_tenant_do_not_hold_up_anothers(database_url: str, tmp_path):
    marks = tmp_path / "marks"
    mark = f"open({str(marks)!r}, 'a').write(open(sys.argv[1] + '/a').read())"
    program = f"import sys; {mark}; {ACCEPTED}"
    async with open_stores(checked_by(program, database_url, tmp_path)) as stores:
        finalized = []
        for tenant in "aaaaaab":
            await stores.keys.create(tenant, "key", ["admin"])
            mine = stores.datasets.for_tenant(tenant)
            dataset = await mine.create("fox")
            await mine.add_file(dataset.id, "a", chunks(tenant.encode()))
            await mine.finalize(dataset.id)
            finalized.append(dataset.id)
        await asyncio.gather(*map(stores.datasets.check, finalized))
    order = marks.read_text()
    assert sorted(order) == sorted("aaaaaab")
    assert order[-1] != "b", order


def checked_by(program: str, database_url: str, folder: Path, **changes: float) -> Settings:
    """Settings by which this program checks datasets."""
    return quick_settings(
        folder / "data", database_url=database_url, check_command=(sys.executable, "-c", program), **changes
    )


async def finalized_dataset(stores: Stores) -> str:
    """Its id; nothing has checked it yet."""
    dataset = await stores.datasets.create("fox")
    await stores.datasets.add_file(dataset.id, "a", chunks(b"x"))
    await stores.datasets.finalize(dataset.id)
    return dataset.id


async def checking(database_url: str, folder: Path, program: str, **changes: float) -> DatasetView:
    """The outcome of a check by this program."""
    async with open_stores(checked_by(program, database_url, folder, **changes)) as stores:
        return await stores.datasets.check(await finalized_dataset(stores))


async def test_a_check_longer_than_the_stall_time_comes_to_its_end_and_runs_once(database_url: str, tmp_path):
    marks = tmp_path / "marks"
    mark = f"open({str(marks)!r}, 'a').write('x')"
    program = f"{mark}; import time; time.sleep(2.5); {ACCEPTED}"
    assert (await checking(database_url, tmp_path, program, **SHORT_STALL)).state == "ready"
    assert marks.read_text() == "x"


async def test_a_check_whose_lease_went_to_another_process_decides_nothing(database_url: str, tmp_path):
    program = f"import time; time.sleep(0.5); {ACCEPTED}"
    settings = checked_by(program, database_url, tmp_path)
    async with open_stores(settings) as stores:
        dataset = await finalized_dataset(stores)
        late = asyncio.create_task(stores.datasets.check(dataset))
        folder = settings.scratch_dir / "checks"
        while not list(folder.glob("*/log.txt")):
            await asyncio.sleep(0.02)
        await stores.jobs._database.fetch(
            "UPDATE datasets SET check_token = gen_random_uuid(), check_until = now() + interval '1 h'"
        )
        while list(folder.iterdir()):
            await asyncio.sleep(0.05)
        await asyncio.wait([late], timeout=0.5)
        assert (await stores.datasets.get(dataset)).state == "finalizing"
        late.cancel()


async def test_a_check_that_is_killed_once_is_made_again(database_url: str, tmp_path):
    marks = tmp_path / "marks"
    program = f"""
import os
open({str(marks)!r}, 'a').write('x')
if os.path.getsize({str(marks)!r}) == 1:
    os.kill(os.getpid(), 9)
{ACCEPTED}
"""
    assert (await checking(database_url, tmp_path, program)).state == "ready"
    assert marks.read_text() == "xx"


async def test_what_a_killed_check_left_is_cleared_away_and_what_is_in_use_stays(
    database_url: str, tmp_path: Path
):
    program = f"import time; time.sleep(2.0); {ACCEPTED}"
    checking_it = asyncio.create_task(checking(database_url, tmp_path, program))
    checks = quick_settings(tmp_path / "data").scratch_dir / "checks"
    while not list(checks.glob("*/log.txt")):
        await asyncio.sleep(0.05)
    (checks / "left" / "input").mkdir(parents=True)
    (checks / "left" / "in-use").touch()
    settings = quick_settings(tmp_path / "data", database_url=database_url)
    async with open_stores(settings) as stores:
        while (checks / "left").exists():
            await stores.datasets.unfinished()
            await asyncio.sleep(0.2)
    assert (await checking_it).state == "ready"


async def test_a_check_that_a_dead_process_began_is_taken_over(stores: Stores):
    dataset = await stores.datasets.create("fox")
    await stores.datasets.add_file(dataset.id, "a", chunks(b"x"))
    await stores.datasets.finalize(dataset.id)
    await stores.jobs._database.fetch(
        "UPDATE datasets SET check_token = gen_random_uuid(), check_until = now() + interval '1 s'"
    )
    assert await stores.datasets.unfinished() == (), "its owner may live yet"
    assert (await stores.datasets.check(dataset.id)).state == "ready"


async def test_a_dataset_with_a_job_is_not_deleted(stores: Stores):
    dataset_id = await ready_dataset(stores, {"a": b"x"})
    job, _ = await stores.jobs.submit(dataset_id, RefineOptions())
    with pytest.raises(Conflict) as caught:
        await stores.datasets.delete(dataset_id)
    assert caught.value.code == "dataset_in_use"
    await stores.jobs.cancel(job.id)
    await stores.jobs.delete(job.id)
    await stores.datasets.delete(dataset_id)
    with pytest.raises(NotFound):
        await stores.datasets.get(dataset_id)
    assert (await stores.datasets.list()).items == ()
