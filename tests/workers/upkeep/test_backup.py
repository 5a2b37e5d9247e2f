"""Backup, wipe, restore: jobs, results, and what was under way are back. With the commands operators use."""

from __future__ import annotations

import asyncio
import hashlib
import os
import shutil
import subprocess
import sys
from collections.abc import AsyncIterator, Iterator
from contextlib import asynccontextmanager
from pathlib import Path

import psutil
import psycopg
import pytest

from tests.workers.buckets import environment_of, fresh_bucket, moto_server
from tests.workers.conftest import (
    ROOT,
    Counting,
    Slots,
    environment,
    quick_settings,
    ready_dataset,
    short_folder,
)
from workers.database.embedded_postgres import EmbeddedPostgres
from workers.database.migrate import migrate
from workers.database.postgres_binaries import find_binaries, server_version
from workers.engine import open_stores
from workers.settings.errors import SetupError
from workers.settings.settings import Settings
from workers.upkeep.backup import make_backup
from workers.upkeep.backup_folder import path_in, read_index
from workers.upkeep.restore import restore_backup

pytestmark = [pytest.mark.server, pytest.mark.anyio]


@pytest.fixture
def home() -> Iterator[Path]:
    with short_folder() as folder:
        yield folder


@asynccontextmanager
async def empty(data_dir: Path, pg_bin: Path | None = None) -> AsyncIterator[Settings]:
    """The private database of an installation, up for the block, with settings that lead to it."""
    private = quick_settings(data_dir)
    postgres = EmbeddedPostgres(private.postgres_dir, pg_bin=pg_bin)
    try:
        yield private.model_copy(update={"database_url": postgres.start()})
    finally:
        postgres.stop()


@asynccontextmanager
async def running(data_dir: Path, pg_bin: Path | None = None) -> AsyncIterator[Settings]:
    """The same, migrated."""
    async with empty(data_dir, pg_bin) as settings:
        migrate(settings.require_database_url())
        yield settings


def command(data_dir: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    """The operator's command, on the private database of the folder."""
    return subprocess.run(
        [sys.executable, "-m", "biresnerf.command_line", *arguments],
        env={**environment(quick_settings(data_dir)), "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
    )


async def contents(settings: Settings, job_id: str) -> dict[str, str]:
    async with open_stores(settings) as stores:
        found = {}
        for artifact in await stores.jobs.artifacts(job_id):
            digest = hashlib.sha256()
            async for chunk in stores.files.read(artifact.key):
                digest.update(chunk)
            assert digest.hexdigest() == artifact.sha256
            found[artifact.name] = artifact.sha256
        return found


async def test_after_backup_wipe_and_restore_jobs_and_results_are_back_and_work_goes_on(
    home: Path, slots: Slots, tmp_path: Path
):
    backup = home / "backup"
    async with running(home / "data") as settings:
        async with open_stores(settings) as stores:
            slot = slots.start(settings, "cpu0")
            done, running_job, queued = (Counting(stores, tmp_path / name) for name in ("a", "b", "c"))
            await done.submit(3, 0.01)
            await done.until_final(90)
            await running_job.submit(80, 0.05)
            await running_job.until(lambda job: job.progress.step >= 20, 90)
            # Held in the middle of its work, however long the backup takes.
            for process in psutil.Process(slot.pid).children(recursive=True):
                process.suspend()
            while "checkpoint" not in await running_job.events():
                await asyncio.sleep(0.05)
            await queued.submit(3, 0.01)
            made = command(home / "data", "backup", str(backup))  # while everything runs
            assert made.returncode == 0, made.stderr
            slot.kill()
            slot.wait()
        before = await contents(settings, done.id)
        assert before.keys() >= {"report.json"}
    shutil.rmtree(home / "data")

    restored = command(home / "data", "restore", str(backup))
    assert restored.returncode == 0, restored.stderr
    async with running(home / "data") as settings:
        assert await contents(settings, done.id) == before
        slots.start(settings, "cpu0")
        async with open_stores(settings) as stores:
            for counting in (running_job, queued):
                counting.stores = stores
                assert (await counting.until_final(90)).state == "succeeded"
            assert int(running_job.starts()[-1]["from"]) >= 10, "it went on from its checkpoint"
            assert [event.type for event in (await stores.jobs.update(done.id)).events][-1] == "succeeded"


async def test_the_next_backup_takes_what_is_new_and_drops_what_was_deleted(home: Path):
    backup = home / "backup"
    async with running(home / "data") as settings, open_stores(settings) as stores:
        first, second = [await ready_dataset(stores, {"a.txt": b"a", "b/c.txt": b"c"}) for _ in range(2)]
        old = await make_backup(settings, settings.require_database_url(), backup)
        kept = {file.key: (backup / "files" / file.key).stat().st_mtime_ns for file in old.files}
        assert any(first in key for key in kept)
        third = await ready_dataset(stores, {"d.txt": b"d"})
        await stores.datasets.delete(first)
        await stores.files.delete_prefix(f"datasets/{first}")
        new = await make_backup(settings, settings.require_database_url(), backup)
        keys = {file.key for file in new.files}
        assert any(third in key for key in keys)
        assert not any(first in key for key in keys)
        assert not list((backup / "files").rglob(f"*{first}*"))
        same = keys & kept.keys()
        assert sum(second in key for key in same) == 2
        assert all((backup / "files" / key).stat().st_mtime_ns == kept[key] for key in same), (
            "not copied again"
        )
        assert [path.name for path in backup.glob("*.dump")] == [new.database]
        assert backup.stat().st_mode & 0o077 == 0


async def test_what_lies_in_a_bucket_comes_back_into_another_one(home: Path):
    backup, content = home / "backup", {"a.png": b"a" * 100_000, "b/c d.txt": b"c"}
    with moto_server() as address:
        buckets = [environment_of(fresh_bucket(address)) for _ in range(2)]
        async with running(home / "old") as base:
            settings = base.model_copy(update=buckets[0])
            async with open_stores(settings) as stores:
                dataset = await ready_dataset(stores, content)
                made = await make_backup(settings, settings.require_database_url(), backup)
                again = await make_backup(settings, settings.require_database_url(), backup)
                assert again.files == made.files, "nothing is new, by the bucket's ETags"
        async with empty(home / "new") as base:
            settings = base.model_copy(update=buckets[1])
            await restore_backup(settings, settings.require_database_url(), backup)
            async with open_stores(settings) as stores:
                assert (await stores.datasets.get(dataset)).state == "ready"
                found = (await stores.datasets.files(dataset)).items
                assert {
                    file.path: b"".join([chunk async for chunk in stores.files.read(file.key)])
                    for file in found
                } == content


async def test_a_backup_is_not_replaced_by_that_of_an_installation_with_other_files(home: Path):
    """As a nightly backup would, once database and files are lost and empty ones have taken their place."""
    backup = home / "backup"
    for name in ("data", "new"):
        async with running(home / name) as settings:
            url = settings.require_database_url()
            if name == "data":
                async with open_stores(settings) as stores:
                    await ready_dataset(stores, {"a.txt": b"abc"})
                before = await make_backup(settings, url, backup)
                continue
            with pytest.raises(SetupError, match="another installation"):  # nothing has used it yet
                await make_backup(settings, url, backup)
            async with open_stores(settings):
                pass
            with pytest.raises(SetupError, match="another installation"):
                await make_backup(settings, url, backup)
    assert read_index(backup) == before
    assert all(path_in(backup, file.key).is_file() for file in before.files)


async def test_a_server_older_than_the_programs_gets_its_database_back(home: Path):
    """From 17 on, what pg_restore says first is an error to servers before 17."""
    backup, older = home / "backup", find_binaries(None).parents[1] / "pginstall/bin"
    assert (
        int(server_version(older).split(".")[0])
        < 17
        <= int(server_version(find_binaries(None)).split(".")[0])
    )
    async with running(home / "data", older) as settings, open_stores(settings) as stores:
        dataset_id = await ready_dataset(stores, {"a.txt": b"abc"})
        await make_backup(settings, settings.require_database_url(), backup)
    async with empty(home / "other", older) as settings:
        await restore_backup(settings, settings.require_database_url(), backup)
        async with open_stores(settings) as stores:
            assert (await stores.datasets.get(dataset_id)).state == "ready"


async def test_a_restore_that_breaks_off_leaves_the_database_empty(home: Path, tmp_path: Path):
    backup, programs = home / "backup", find_binaries(None)
    async with running(home / "data") as settings, open_stores(settings) as stores:
        await ready_dataset(stores, {"a.txt": b"abc"})
        await make_backup(settings, settings.require_database_url(), backup)
    for name in ("initdb", "postgres", "psql", "pg_restore"):
        (tmp_path / name).write_text(f'#!/bin/sh\nexec {programs / name} "$@"\n')
        (tmp_path / name).chmod(0o755)
    # Killed between two statements, when the tables are there and their rows are not.
    breaks_off = f"#!/bin/sh\n{programs / 'pg_restore'} \"$@\" | sed '/^COPY/,$d'\nkill -KILL $$\n"
    (tmp_path / "pg_restore").write_text(breaks_off)
    async with empty(home / "other") as settings:
        url = settings.require_database_url()
        with pytest.raises(SetupError) as told:
            await restore_backup(settings.model_copy(update={"pg_bin": tmp_path}), url, backup)
        assert told.value.code == "pg_restore_failed"
        with psycopg.connect(url) as connection:
            assert connection.execute("SELECT to_regclass('jobs')").fetchone() == (None,)
        await restore_backup(settings, url, backup)


async def test_a_damaged_backup_or_a_place_that_is_taken_is_refused_and_left_as_it_was(home: Path):
    backup = home / "backup"
    async with running(home / "data") as settings, open_stores(settings) as stores:
        url = settings.require_database_url()
        dataset_id = await ready_dataset(stores, {"a.txt": b"abc"})
        index = await make_backup(settings, url, backup)
        with pytest.raises(SetupError) as told:
            await restore_backup(settings, url, backup)
        assert told.value.code == "database_not_empty"
        with pytest.raises(SetupError) as told:
            await make_backup(settings, url, home / "data")
        assert told.value.code == "folder_unusable"
        assert (await stores.files.head(index.files[0].key)).size > 0
    (victim,) = (backup / "files").rglob("a.txt")
    victim.write_bytes(b"abd")
    async with empty(home / "other") as settings:
        url = settings.require_database_url()
        with pytest.raises(SetupError) as told:
            await restore_backup(settings, url, backup)
        assert told.value.code == "backup_damaged"
        victim.write_bytes(b"abc")
        await restore_backup(settings, url, backup)  # begun again, it goes through
        async with open_stores(settings) as stores:
            assert (await stores.datasets.get(dataset_id)).state == "ready"
            assert (await stores.datasets.file(dataset_id, "a.txt")).size == 3
        with pytest.raises(SetupError) as told:
            await restore_backup(settings, url, home / "data")
        assert told.value.code == "no_backup"
    async with empty(home / "third") as settings:
        settings = settings.model_copy(update={"data_dir": home / "data"})  # the files of the first one
        (home / "data" / "files" / "store-id").write_text("of somebody else")
        with pytest.raises(SetupError) as told:
            await restore_backup(settings, settings.require_database_url(), backup)
        assert told.value.code == "store_not_empty"


def test_a_folder_without_a_backup_makes_no_installation(home: Path):
    (home / "backup").mkdir()
    told = command(home / "data", "restore", str(home / "backup"))
    assert told.returncode == 2
    assert "no whole backup" in told.stderr
    assert not (home / "data").exists()


async def test_the_password_of_the_database_is_not_on_a_command_line(home: Path, tmp_path: Path):
    async with running(home / "data") as settings:
        seen = tmp_path / "seen"
        spy = tmp_path / "bin"
        spy.mkdir()
        for name in ("initdb", "postgres", "pg_dump"):
            (spy / name).write_text(f'#!/bin/sh\necho "$@" >> {seen}\nexit 1\n')
            (spy / name).chmod(0o755)
        secret = settings.require_database_url().replace("postgres@", "postgres:hidden-word@")
        with psycopg.connect(secret):  # trust: any password passes
            pass
        told = subprocess.run(
            [sys.executable, "-m", "biresnerf.command_line", "backup", str(tmp_path / "backup")],
            env={
                **os.environ,
                "BIRESNERF_DATABASE_URL": secret,
                "BIRESNERF_PG_BIN": str(spy),
                "BIRESNERF_DATA_DIR": str(home / "data"),
                "PYTHONPATH": str(ROOT),
            },
            capture_output=True,
            text=True,
        )
        assert told.returncode == 2
        assert "dbname=postgres" in seen.read_text()
        assert "hidden-word" not in seen.read_text() + told.stderr
