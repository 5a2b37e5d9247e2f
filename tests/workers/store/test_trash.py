"""Listed folders are deleted, and one that cannot be deleted does not block others."""

from __future__ import annotations

from pathlib import Path

import pytest

from workers.database.database import open_database
from workers.settings.errors import Unavailable
from workers.store.file_places import LocalPlace
from workers.store.files import FileStore
from workers.store.trash import RETRY_S, discard, empty_trash

pytestmark = pytest.mark.anyio


async def test_a_folder_that_cannot_be_deleted_is_tried_later_and_keeps_no_other(
    database_url: str, tmp_path: Path
):
    files = FileStore(LocalPlace(tmp_path / "files"))
    names = ("jobs/a", "jobs/b")
    async with open_database(database_url, connections=2) as database:
        for name in names:
            await files.put_bytes(f"{name}/one", b"x")
            await database.run(discard, name)
        loop = tmp_path / "files" / "jobs" / "a" / "two"
        loop.symlink_to(loop)  # the store cannot say what it is
        with pytest.raises(Unavailable):
            await empty_trash(database, files)
        await empty_trash(database, files)
        assert await files.list("jobs/b") == []
        (left,) = await database.fetch(
            "SELECT prefix, extract(epoch FROM not_before - clock_timestamp())::float8 AS in_s FROM trash"
        )
        assert left["prefix"] == "jobs/a"
        assert 0 < left["in_s"] <= RETRY_S
