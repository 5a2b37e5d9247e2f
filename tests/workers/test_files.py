"""The file store on a real folder."""

from __future__ import annotations

from collections.abc import AsyncIterator
from pathlib import Path

import pytest

from workers.errors import LimitReached, NotFound, SetupError
from workers.files import FileStore

pytestmark = pytest.mark.anyio


async def stream(content: bytes, size: int = 2**20) -> AsyncIterator[bytes]:
    for start in range(0, len(content), size):
        yield content[start : start + size]


@pytest.fixture
def files(tmp_path: Path) -> FileStore:
    return FileStore(tmp_path / "store")


async def test_ranges_are_half_open_and_clipped(files: FileStore):
    content = bytes(range(256)) * 20_000
    await files.put("a/b", stream(content), limit_bytes=len(content))

    async def part(start: int, end: int | None) -> bytes:
        return b"".join([chunk async for chunk in files.read("a/b", start, end)])

    assert await part(0, None) == content
    assert await part(7, 9) == content[7:9]
    assert await part(len(content) - 3, len(content) + 100) == content[-3:]
    assert await part(len(content), None) == b""
    assert (await files.head("a/b")).size == len(content)


async def test_a_stream_over_the_limit_stores_nothing(files: FileStore, tmp_path: Path):
    with pytest.raises(LimitReached):
        await files.put("a/b", stream(b"x" * 20_000_000), limit_bytes=19_999_999)
    with pytest.raises(NotFound):
        await files.head("a/b")
    assert [path for path in (tmp_path / "store").rglob("*") if path.is_file()] == []
    stored = await files.put("a/b", stream(b"x" * 20_000_000), limit_bytes=20_000_000)
    assert stored.size == 20_000_000


async def test_the_tag_changes_with_the_content(files: FileStore):
    first = await files.put("a", stream(b"one"), limit_bytes=9)
    second = await files.put("a", stream(b"three"), limit_bytes=9)
    assert first.etag != second.etag


async def test_prefixes_are_whole_folders(files: FileStore):
    for key in ("jobs/1/a", "jobs/1/b/c", "jobs/10/a"):
        await files.put(key, stream(b"x"), limit_bytes=1)
    assert [file.key for file in await files.list("jobs/1")] == ["jobs/1/a", "jobs/1/b/c"]
    await files.delete_prefix("jobs/1", keep="b")
    assert [file.key for file in await files.list("jobs")] == ["jobs/1/b/c", "jobs/10/a"]
    await files.delete_prefix("jobs/1")
    await files.delete_prefix("jobs/1")
    await files.delete("jobs/none")
    assert [file.key for file in await files.list("jobs")] == ["jobs/10/a"]


@pytest.mark.parametrize("key", ["", "/a", "../a", "a/../../b", "a//b", "./a", "a/"])
async def test_a_key_cannot_leave_the_store(files: FileStore, key: str):
    with pytest.raises(ValueError, match="not a key"):
        await files.put(key, stream(b"x"), limit_bytes=1)
    with pytest.raises(ValueError, match="not a key"):
        await files.stage([("a", key)], files.root)
    if not key.endswith("/"):
        with pytest.raises(ValueError, match="not a key"):
            await files.delete_prefix(key)


async def test_staging_copies_into_folders(files: FileStore, tmp_path: Path):
    await files.put("d/v/images/ü.png", stream(b"abc"), limit_bytes=3)
    assert await files.stage([("d/v/images/ü.png", "images/ü.png")], tmp_path / "out") == 3
    assert (tmp_path / "out/images/ü.png").read_bytes() == b"abc"


def test_a_folder_that_cannot_be_used_is_a_setup_error(tmp_path: Path):
    (tmp_path / "file").write_text("")
    with pytest.raises(SetupError):
        FileStore(tmp_path / "file" / "store")
