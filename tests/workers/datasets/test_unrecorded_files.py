"""Files that were stored, and then not recorded: the process was killed, too slow, or lost the database."""

from __future__ import annotations

import asyncio
import subprocess
import sys
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path

import pytest

from tests.workers.conftest import environment, quick_settings
from workers.database.database import Connection, Database
from workers.engine import Stores, open_stores
from workers.settings.errors import Unavailable
from workers.settings.settings import Settings
from workers.store.trash import empty_trash

pytestmark = pytest.mark.anyio
EXPIRY_S = 3.0
# Adds a file to the dataset; killed once the file is stored.
KILLED = """
import asyncio, os, sys
from workers.engine import open_stores
from workers.settings.settings import Settings
from workers.store.files import FileStore

put = FileStore.put

async def put_and_die(*arguments, **named):
    await put(*arguments, **named)
    os._exit(9)

async def main():
    async with open_stores(Settings()) as stores:
        FileStore.put = put_and_die
        await stores.datasets.add_file(sys.argv[1], "a", chunks())

async def chunks():
    yield b"abc"

asyncio.run(main())
"""


@pytest.fixture
def settings(database_url: str, tmp_path: Path) -> Settings:
    return quick_settings(tmp_path / "data", database_url=database_url, upload_expiry_s=EXPIRY_S)


@pytest.fixture
async def database(stores: Stores) -> Database:
    return stores.datasets._database


async def chunks(content: bytes) -> AsyncIterator[bytes]:
    yield content


async def test_a_file_that_a_killed_process_did_not_record_is_deleted(
    stores: Stores, database: Database, settings: Settings
):
    dataset = await stores.datasets.create("fox")
    killed = subprocess.run([sys.executable, "-c", KILLED, dataset.id], env=environment(settings))
    assert killed.returncode == 9
    assert len(await stores.files.list(f"datasets/{dataset.id}")) == 1
    assert (await stores.datasets.get(dataset.id)).files == 0
    await asyncio.sleep(EXPIRY_S)
    await empty_trash(database, stores.files)
    assert await stores.files.list(f"datasets/{dataset.id}") == []


async def test_a_recorded_file_outlives_the_time_to_record_it(stores: Stores, database: Database):
    dataset = await stores.datasets.create("fox")
    file, _ = await stores.datasets.add_file(dataset.id, "a", chunks(b"abc"))
    await asyncio.sleep(EXPIRY_S)
    await empty_trash(database, stores.files)
    assert [found.key for found in await stores.files.list("datasets")] == [file.key]
    assert await database.fetch("SELECT 1 FROM trash") == []


async def test_a_file_that_is_recorded_too_late_is_refused(database_url: str, tmp_path: Path):
    """A janitor may have deleted it by then: this process was frozen."""
    hasty = quick_settings(tmp_path / "data", database_url=database_url, upload_expiry_s=0.1)
    async with open_stores(hasty) as stores:
        dataset = await stores.datasets.create("fox")

        async def slowly() -> AsyncIterator[bytes]:
            yield b"abc"
            await asyncio.sleep(0.2)

        with pytest.raises(Unavailable):
            await stores.datasets.add_file(dataset.id, "a", slowly())
        assert (await stores.datasets.get(dataset.id)).files == 0
        assert await stores.files.list("datasets") == []


async def test_a_recorded_file_stays_where_only_the_acknowledgement_was_lost(
    stores: Stores, database: Database, monkeypatch: pytest.MonkeyPatch
):
    dataset = await stores.datasets.create("fox")
    transaction, begun = Database.transaction, []

    @asynccontextmanager
    async def loses_the_second_answer(self: Database) -> AsyncIterator[Connection]:
        begun.append(self)
        async with transaction(self) as connection:
            yield connection
        if len(begun) == 2:
            raise Unavailable("database_unavailable", "the connection broke after the commit")

    monkeypatch.setattr(Database, "transaction", loses_the_second_answer)
    with pytest.raises(Unavailable):
        await stores.datasets.add_file(dataset.id, "a", chunks(b"abc"))
    file = await stores.datasets.file(dataset.id, "a")
    assert [found.key for found in await stores.files.list("datasets")] == [file.key]
