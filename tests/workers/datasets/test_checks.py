"""Checks of datasets: once, by one process, and repeated if they were interrupted."""

from __future__ import annotations

import asyncio
import sys
from pathlib import Path

import pytest

from biresnerf.wire.datasets import CheckProgress, DatasetView
from tests.workers.conftest import ACCEPTED, SHORT_STALL, environment, quick_settings
from tests.workers.datasets.test_datasets import chunks
from workers.database.losses import LOSSES_MAX
from workers.datasets import dataset_check
from workers.datasets.dataset_check import Take
from workers.engine import Stores, open_stores
from workers.process.disk_space import EXIT_DISK
from workers.settings.settings import Settings

pytestmark = pytest.mark.anyio

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
        dataset = await finalized_dataset(stores)
        checked = await stores.datasets.check(dataset)
        assert checked.error is not None
        assert (checked.state, checked.error.code) == ("rejected", code)
    assert list((settings.scratch_dir / "checks").iterdir()) == []


async def test_a_set_of_few_and_small_files_is_not_checked_for_as_long_as_the_largest(
    database_url: str, tmp_path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(dataset_check, "ANY_S", 0.5)
    monkeypatch.setattr(dataset_check, "FILE_S", 0.5)
    async with asyncio.timeout(20):
        checked = await checking(database_url, tmp_path, "import time; time.sleep(60)", check_timeout_s=900.0)
    assert checked.error is not None
    assert (checked.error.code, checked.error.detail) == ("check_timeout", "The check took longer than 1 s.")


async def test_a_check_that_found_the_disk_full_is_made_again(database_url: str, tmp_path):
    mark = tmp_path / "mark"
    full_once = f"mark = pathlib.Path({str(mark)!r}); mark.exists() or (mark.touch(), sys.exit({EXIT_DISK}))"
    program = f"import pathlib, sys; {full_once}; {ACCEPTED}"
    async with open_stores(checked_by(program, database_url, tmp_path)) as stores:
        dataset = await finalized_dataset(stores)
        with pytest.raises(OSError, match="no room"):
            await stores.datasets.check(dataset)
        assert (await stores.datasets.get(dataset)).state == "finalizing"
        assert (await stores.datasets.check(dataset)).state == "ready"


async def test_how_many_photos_a_check_has_read_is_known_while_it_runs(database_url: str, tmp_path):
    go = tmp_path / "go"
    said = """print('{"photos_read": 3, "photos": 7}', flush=True)"""
    program = f"import pathlib, time; {said}\nwhile not pathlib.Path({str(go)!r}).exists(): time.sleep(0.05)"
    beats = {"beat_s": 60.0, "stall_s": 600.0}  # long ones, as signs of life
    settings = checked_by(f"{program}\n{ACCEPTED}", database_url, tmp_path, **beats)
    async with open_stores(settings) as stores:
        dataset = await finalized_dataset(stores)
        assert (await stores.datasets.get(dataset)).checked is None
        running = asyncio.create_task(stores.datasets.check(dataset))
        async with asyncio.timeout(20):
            while not (found := await stores.datasets.get(dataset)).checked:
                await asyncio.sleep(0.1)
        assert (found.state, found.checked) == ("finalizing", CheckProgress(photos_read=3, photos=7))
        (listed,) = (await stores.datasets.list(limit=10)).items
        assert listed.checked == found.checked
        go.touch()
        ready = await running
        assert (ready.state, ready.checked) == ("ready", None)


async def test_two_checks_at_once_run_the_program_once(database_url: str, tmp_path):
    marks = tmp_path / "marks"
    program = f"open({str(marks)!r}, 'a').write('x'); import time; time.sleep(0.3); {ACCEPTED}"
    settings = checked_by(program, database_url, tmp_path)
    async with open_stores(settings) as one, open_stores(settings) as other:
        dataset = await finalized_dataset(one)
        checked = await asyncio.gather(one.datasets.check(dataset), other.datasets.check(dataset))
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
    (checks / "left" / ".in-use").touch()
    settings = quick_settings(tmp_path / "data", database_url=database_url)
    async with open_stores(settings) as stores:
        while (checks / "left").exists():
            await stores.datasets.unfinished()
            await asyncio.sleep(0.2)
    assert (await checking_it).state == "ready"


async def test_a_check_that_a_dead_process_began_is_taken_over(stores: Stores):
    dataset = await finalized_dataset(stores)
    await stores.jobs._database.fetch(
        "UPDATE datasets SET check_token = gen_random_uuid(), check_until = now() + interval '1 s'"
    )
    assert await stores.datasets.unfinished() == (), "its owner may live yet"
    assert (await stores.datasets.check(dataset)).state == "ready"


# One process after the other checks the set, until it is checked.
CHECKING = """
import asyncio, sys
from workers.engine import open_stores
from workers.settings.settings import Settings
async def check():
    async with open_stores(Settings()) as stores:
        await stores.datasets.check(sys.argv[1])
asyncio.run(check())
"""
# Reads as many photos as the list says for this take, and takes its parent down; accepts the set once the list is over.
KILLS = """
import json, os, signal, time
with open({marks!r}, "a+") as marks:
    marks.seek(0)
    take = len(marks.read())
    marks.write("x")
reads = {reads!r}
if take < len(reads):
    print(json.dumps({{"photos_read": reads[take], "photos": 100}}), flush=True)
    time.sleep({beats_s})
    os.kill(os.getppid(), signal.SIGKILL)
"""


async def after_kills(
    database_url: str, folder: Path, reads: list[int], beats_s: float = 0.5
) -> tuple[DatasetView, int]:
    """The outcome if each check but the last takes its process down after so many photos, and the number of checks."""
    marks = folder / "marks"
    program = KILLS.format(marks=str(marks), reads=reads, beats_s=beats_s) + ACCEPTED
    settings = checked_by(program, database_url, folder, beat_s=0.1)
    async with open_stores(settings) as stores:
        dataset = await finalized_dataset(stores)
        while (await stores.datasets.get(dataset)).state == "finalizing":
            process = await asyncio.create_subprocess_exec(
                *(sys.executable, "-c", CHECKING, dataset), env=environment(settings)
            )
            await process.wait()
        return await stores.datasets.get(dataset), len(marks.read_text())


async def test_a_set_that_takes_down_each_process_that_checks_it_is_rejected(
    database_url: str, tmp_path: Path
):
    checked, takes = await after_kills(database_url, tmp_path, [0] * 100, beats_s=0.0)
    assert checked.error is not None
    assert (checked.state, checked.error.code) == ("rejected", "check_crashed")
    assert f"{LOSSES_MAX} processes were lost" in checked.error.detail
    assert takes == LOSSES_MAX


async def test_a_check_that_gets_further_each_time_its_process_is_killed_is_made_again(
    database_url: str, tmp_path: Path
):
    reads = [*range(1, LOSSES_MAX + 3)]
    checked, takes = await after_kills(database_url, tmp_path, reads)
    assert (checked.state, takes) == ("ready", len(reads) + 1)


async def test_checks_that_get_no_further_than_one_before_are_given_up(database_url: str, tmp_path: Path):
    checked, takes = await after_kills(database_url, tmp_path, [2, 5] + 100 * [4, 5])
    assert checked.error is not None
    assert (checked.state, checked.error.code) == ("rejected", "check_crashed")
    assert LOSSES_MAX < takes <= 2 * LOSSES_MAX, "2 + LOSSES_MAX, unless the machine was too slow to note one"


async def test_processes_that_are_lost_before_they_read_a_set_do_not_count(stores: Stores):
    dataset = await finalized_dataset(stores)
    for _ in range(LOSSES_MAX + 1):
        await stores.jobs._database.fetch(
            "UPDATE datasets SET check_token = gen_random_uuid(), check_until = now() - interval '1 s'"
        )
        assert await stores.datasets._checker._take(Take(dataset))
        await stores.jobs._database.fetch("UPDATE datasets SET check_until = now() - interval '1 s'")
    assert (await stores.datasets.check(dataset)).state == "ready"


@pytest.mark.parametrize("how", ["a full disk", "a shutdown", "a frozen process"])
async def test_what_ends_a_check_and_is_not_the_files_fault_is_no_loss(
    database_url: str, tmp_path: Path, how: str
):
    program = f"import sys; sys.exit({EXIT_DISK})" if how == "a full disk" else "import time; time.sleep(60)"
    settings = checked_by(program, database_url, tmp_path)
    async with open_stores(settings) as stores:
        dataset, database = await finalized_dataset(stores), stores.jobs._database
        await database.fetch("UPDATE datasets SET check_losses = %s", LOSSES_MAX - 1)
        running = asyncio.create_task(stores.datasets.check(dataset))
        if how == "a full disk":
            with pytest.raises(OSError, match="no room"):
                await running
        while not running.done() and not list((settings.scratch_dir / "checks").glob("*/log.txt")):
            await asyncio.sleep(0.02)
        if how == "a frozen process":  # another took the dataset, for it seemed to be dead; now it goes on
            await database.fetch(
                "UPDATE datasets SET check_token = gen_random_uuid(), check_until = now() + interval '1 h'"
            )
        running.cancel()
        await asyncio.wait([running])
        assert (await database.fetch("SELECT check_losses FROM datasets"))[0]["check_losses"] == 0
