"""The contract of the file store, on a real folder and on two S3 servers."""

from __future__ import annotations

import contextlib
from collections.abc import AsyncIterator, Iterator
from pathlib import Path

import httpx
import pytest

from biresnerf.errors import InputError
from biresnerf.wire.safe_paths import PART_BYTES_MAX, PATH_BYTES_MAX, checked_path
from tests.workers.buckets import by_boto, fresh_bucket, moto_server, s3rver_server
from workers.datasets.dataset_rows import file_key
from workers.settings.errors import LimitReached, NotFound, SetupError, Unavailable
from workers.store import file_places
from workers.store.file_places import Bucket, BucketPlace, LocalPlace
from workers.store.files import PART_BYTES, FileStore

pytestmark = pytest.mark.anyio
BUCKETS = [pytest.param(kind, marks=pytest.mark.server) for kind in ("moto", "s3rver")]
LARGE = bytes(range(256)) * 80_000  # 20 MB: three parts


async def stream(content: bytes, size: int = 2**20) -> AsyncIterator[bytes]:
    for start in range(0, len(content), size):
        yield content[start : start + size]


@pytest.fixture(scope="module")
def moto() -> Iterator[str]:
    with moto_server() as address:
        yield address


@pytest.fixture(scope="module")
def s3rver() -> Iterator[str]:
    with s3rver_server() as address:
        yield address


@pytest.fixture(params=["folder", *BUCKETS])
def files(request: pytest.FixtureRequest, tmp_path: Path) -> FileStore:
    if request.param == "folder":
        return FileStore(LocalPlace(tmp_path / "store"))
    return FileStore(BucketPlace(fresh_bucket(request.getfixturevalue(request.param)), patience_s=5))


@pytest.fixture
def bucket(moto: str) -> Bucket:
    return fresh_bucket(moto)


async def content_of(files: FileStore, key: str, start: int = 0, end: int | None = None) -> bytes:
    return b"".join([chunk async for chunk in files.read(key, start, end)])


async def put(files: FileStore, key: str, content: bytes) -> None:
    stored = await files.put(key, stream(content), limit_bytes=len(content))
    assert stored.size == len(content)


async def test_ranges_are_half_open_and_clipped(files: FileStore):
    await put(files, "a/b", LARGE)
    assert await content_of(files, "a/b") == LARGE
    assert await content_of(files, "a/b", 7, 9) == LARGE[7:9]
    across = slice(PART_BYTES - 5, PART_BYTES + 5)
    assert await content_of(files, "a/b", across.start, across.stop) == LARGE[across]
    assert await content_of(files, "a/b", len(LARGE) - 3, len(LARGE) + 100) == LARGE[-3:]
    assert await content_of(files, "a/b", len(LARGE), None) == b""
    assert (await files.head("a/b")).size == len(LARGE)


async def test_an_empty_file_is_a_file(files: FileStore):
    await put(files, "a/empty", b"")
    assert await content_of(files, "a/empty") == b""
    assert [file.size for file in await files.list("a")] == [0]


@pytest.mark.parametrize("size", [20, len(LARGE)])
async def test_a_stream_over_the_limit_stores_nothing(files: FileStore, size: int):
    with pytest.raises(LimitReached) as caught:
        await files.put("a/b", stream(LARGE[:size]), limit_bytes=size - 1)
    assert caught.value.code == "body_too_large"
    with pytest.raises(NotFound):
        await files.head("a/b")
    assert await files.list("a") == []


@pytest.mark.parametrize("size", [20, len(LARGE)])
async def test_a_wrong_digest_or_a_broken_stream_leaves_the_old_file(files: FileStore, size: int):
    async def broken() -> AsyncIterator[bytes]:
        yield LARGE[:size]
        raise KeyError("the client went away")

    await put(files, "a/b", b"old")
    with pytest.raises(InputError, match="SHA-256"):
        await files.put("a/b", stream(LARGE[:size]), limit_bytes=size, expected_sha256="0" * 64)
    with pytest.raises(KeyError):
        await files.put("a/b", broken(), limit_bytes=size)
    assert await content_of(files, "a/b") == b"old"


async def test_the_tag_changes_with_the_content(files: FileStore):
    first = await files.put("a", stream(b"one"), limit_bytes=9)
    second = await files.put("a", stream(b"three"), limit_bytes=9)
    assert first.etag != second.etag
    assert (await files.head("a")).etag == second.etag


async def test_names_of_all_kinds_come_back_as_they_were(files: FileStore):
    names = ["n/ü é.png", "n/a+b&c=d.png", "n/50%20 off#1.png", "n/~?*.png", "n/..hidden", "n/日本/写真.jpg"]
    for name in names:
        await put(files, name, name.encode())
    assert [file.key for file in await files.list("n")] == sorted(names)
    for name in names:
        assert await content_of(files, name) == name.encode()


async def test_prefixes_are_whole_folders(files: FileStore):
    for key in ("jobs/1/a", "jobs/1/b/c", "jobs/10/a"):
        await put(files, key, b"x")
    assert [file.key for file in await files.list("jobs/1")] == ["jobs/1/a", "jobs/1/b/c"]
    await files.delete_prefix("jobs/1", keep="b")
    assert [file.key for file in await files.list("jobs")] == ["jobs/1/b/c", "jobs/10/a"]
    await files.delete_prefix("jobs/1")
    await files.delete_prefix("jobs/1")
    await files.delete("jobs/none")
    assert [file.key for file in await files.list("jobs")] == ["jobs/10/a"]


async def test_a_copy_lives_on_when_its_source_is_deleted(files: FileStore):
    await put(files, "a/one", b"same")
    assert (await files.copy("a/one", "b/two")).size == 4
    await files.delete("a/one")
    assert await content_of(files, "b/two") == b"same"
    with pytest.raises(NotFound):
        await files.copy("a/one", "b/three")


@pytest.mark.parametrize("key", ["", "/a", "../a", "a/../../b", "a//b", "./a", "a/"])
async def test_a_key_cannot_leave_the_store(files: FileStore, key: str, tmp_path: Path):
    with pytest.raises(ValueError, match="not a key"):
        await files.put(key, stream(b"x"), limit_bytes=1)
    with pytest.raises(ValueError, match="not a key"):
        await files.stage([("a", key)], tmp_path)
    with pytest.raises(ValueError, match="not a key"):
        await files.signed_urls("GET", [key], 60)
    if not key.endswith("/"):
        with pytest.raises(ValueError, match="not a key"):
            await files.delete_prefix(key)


async def test_staging_copies_into_folders(files: FileStore, tmp_path: Path):
    await put(files, "d/v/images/ü.png", b"abc")
    assert await files.stage([("d/v/images/ü.png", "images/ü.png")], tmp_path / "out") == 3
    assert (tmp_path / "out/images/ü.png").read_bytes() == b"abc"


async def test_files_to_read_only_take_no_room_in_a_folder_beside_the_store(tmp_path: Path):
    files = FileStore(LocalPlace(tmp_path / "store"))
    await put(files, "d/v/images/ü #1%.png", b"abc")
    await put(files, "d/v/images/b.png", b"abc")
    members = [("d/v/images/ü #1%.png", "a.png"), ("d/v/images/b.png", "images/b.png")]
    assert files.links_into(tmp_path)
    await files.stage(members, tmp_path / "out", to_read_only=True)
    assert (tmp_path / "out/a.png").read_bytes() == (tmp_path / "out/images/b.png").read_bytes() == b"abc"
    assert (tmp_path / "out/images/b.png").stat().st_nlink == 2, "one file, two names"
    await put(files, "d/v/images/b.png", b"new")
    assert (tmp_path / "out/images/b.png").read_bytes() == b"abc", "a job keeps what it was given"
    await files.delete_prefix("d")
    assert (tmp_path / "out/images/b.png").read_bytes() == b"abc"


async def test_a_working_store_is_healthy(files: FileStore):
    assert await files.healthy()


@pytest.mark.parametrize("kind", BUCKETS)
async def test_a_signed_address_serves_ranges_and_takes_one_key_for_its_time(
    request: pytest.FixtureRequest, kind: str
):
    bucket = fresh_bucket(request.getfixturevalue(kind))
    files = FileStore(BucketPlace(bucket, 5))
    await files.put("r/a b.png", stream(b"0123456789"), limit_bytes=10, media_type="image/png")
    found = await files.signed_urls("GET", ["r/a b.png"], 60)
    assert found is not None
    with httpx.Client() as stranger:
        answer = stranger.get(found[0], headers={"Range": "bytes=2-4"})
        assert (answer.status_code, answer.content) == (206, b"234")
        assert answer.headers["content-type"] == "image/png"
        assert answer.headers["content-disposition"] == "attachment"
        put_at = await files.signed_urls("PUT", ["in/new"], 60)
        assert put_at is not None
        assert stranger.put(put_at[0], content=b"sent").status_code == 200
    assert await content_of(files, "in/new") == b"sent"


async def test_a_folder_signs_nothing(tmp_path: Path):
    assert await FileStore(LocalPlace(tmp_path)).signed_urls("GET", ["a"], 60) is None


async def test_files_lie_below_the_prefix_and_uploads_that_break_leave_no_parts(bucket: Bucket):
    async def broken() -> AsyncIterator[bytes]:
        yield LARGE
        raise KeyError

    files = FileStore(BucketPlace(bucket, 5))
    with contextlib.suppress(KeyError):
        await files.put("a/b", broken(), limit_bytes=len(LARGE))
    await put(files, "a/c", b"x")
    amazon = by_boto(bucket)
    assert [item["Key"] for item in amazon.list_objects_v2(Bucket=bucket.name)["Contents"]] == [
        "some/prefix/a/c"
    ]
    assert "Uploads" not in amazon.list_multipart_uploads(Bucket=bucket.name)


async def test_more_files_than_one_request_deletes_go_away_together(
    bucket: Bucket, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(file_places, "DELETE_BATCH", 5)
    files = FileStore(BucketPlace(bucket, 5))
    for number in range(12):
        await put(files, f"j/{number}", b"x")
    await files.delete_prefix("j", keep="none")
    assert await files.list("j") == []


async def test_a_bucket_that_is_away_is_said_to_be(bucket: Bucket):
    gone = FileStore(BucketPlace(Bucket("none", endpoint=bucket.endpoint), 1))
    deaf = FileStore(BucketPlace(Bucket("none", endpoint="http://127.0.0.1:9"), 1))
    for files in (gone, deaf):
        assert not await files.healthy()
        with pytest.raises(Unavailable) as caught:
            await files.put("a", stream(b"x"), limit_bytes=1)
        assert caught.value.code == "storage_unavailable"
    with pytest.raises(Unavailable):
        await deaf.head("a")
    with pytest.raises(Unavailable):
        await content_of(deaf, "a")
    with pytest.raises(Unavailable):
        await deaf.delete_prefix("a")


def test_a_folder_or_address_that_cannot_be_used_is_a_setup_error(tmp_path: Path):
    (tmp_path / "file").write_text("")
    with pytest.raises(SetupError):
        LocalPlace(tmp_path / "file" / "store")
    for url in ("http://host/bucket", "s3://", "s3:bucket", "s3://key:secret@bucket/x", "bucket"):
        with pytest.raises(SetupError, match="BIRESNERF_STORAGE_URL"):
            Bucket.at(url)
    assert Bucket.at("s3://photos.of-us/a/b/") == Bucket("photos.of-us", "a/b")


async def test_the_longest_names_that_clients_may_send_can_be_stored(files: FileStore):
    part = "é" * (PART_BYTES_MAX // 2)
    path = f"{part}/{part}/{part}/" + "x" * (PATH_BYTES_MAX - 3 * PART_BYTES_MAX - 3)
    assert checked_path(path) == path
    key = file_key("datasets/ds_01J9ZQ4R7V0000000000000000/files", path)
    await put(files, key, b"x")
    assert await content_of(files, key) == b"x"


async def test_a_name_that_the_store_cannot_hold_is_the_clients_fault_and_tells_no_path(tmp_path: Path):
    files = FileStore(LocalPlace(tmp_path / "store"))
    with pytest.raises(InputError) as caught:
        await put(files, "a/" + "x" * 254, b"x")
    assert caught.value.code == "unsafe_path"
    assert str(tmp_path) not in str(caught.value)
    (tmp_path / "store/folder").mkdir()
    with pytest.raises(Unavailable) as refused:
        await put(files, "folder", b"x")
    assert str(tmp_path) not in str(refused.value)
