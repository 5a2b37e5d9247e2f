"""Files come from addresses whole or not at all, whatever servers, dispatchers and addresses do on the way."""

from __future__ import annotations

import asyncio
import time
import uuid
from pathlib import Path

import psycopg
import pytest

from biresnerf.errors import InputError
from biresnerf.wire.datasets import FileAddress
from tests.workers.datasets.file_server import FileServer
from tests.workers.webhooks.conftest import dispatchers, settings
from tests.workers.webhooks.webhook_receiver import PATIENCE_S, Dispatchers, until
from workers.database.losses import LOSSES_MAX
from workers.datasets import fetcher
from workers.datasets.uploads import PIECE_MAX_BYTES
from workers.engine import Stores, open_stores
from workers.records import Upload
from workers.settings.errors import Conflict, LimitReached, NotFound
from workers.settings.settings import Settings

__all__ = ["dispatchers", "settings"]
pytestmark = pytest.mark.anyio
# Two pieces and a bit.
CONTENT = bytes(range(256)) * 36_000


@pytest.fixture(autouse=True)
async def files():
    async with FileServer().open() as server:
        yield server


async def fetch(stores: Stores, url: str, path: str | None = "a.jpg", **said: object) -> Upload:
    dataset = await stores.datasets.create("test")
    (upload,) = await stores.uploads.fetch(dataset.id, [FileAddress(url=url, path=path, **said)])
    return upload


async def over(stores: Stores, upload: Upload) -> Upload:
    """The upload once it is received or rejected."""
    end = time.monotonic() + 3 * PATIENCE_S  # a dispatcher of its own process takes a while to start
    while (now := await stores.uploads.get(upload.id)).state == "receiving":
        assert time.monotonic() < end, now
        await asyncio.sleep(0.02)
    return now


async def content_of(stores: Stores, upload: Upload) -> bytes:
    return b"".join([chunk async for chunk in stores.uploads.content(upload)])


async def addresses(stores: Stores) -> int:
    """How many the database still knows."""
    return len(await stores.uploads._database.fetch("SELECT 1 FROM upload_fetches"))


async def assert_whole(stores: Stores, upload: Upload, content: bytes) -> None:
    now = await over(stores, upload)
    assert (now.state, now.error, now.size) == ("received", None, len(content))
    assert await content_of(stores, now) == content
    assert await addresses(stores) == 0


@pytest.mark.parametrize("chunked", [False, True], ids=["length said", "length unknown"])
@pytest.mark.parametrize("content", [b"", b"abc", CONTENT], ids=["empty", "small", "pieces"])
async def test_a_file_comes_whole_and_its_address_is_forgotten(
    stores: Stores, dispatchers: Dispatchers, files: FileServer, content: bytes, chunked: bool
):
    upload = await fetch(stores, files.file("/a.jpg", content, chunked=chunked), size=len(content))
    assert (upload.state, upload.host) == ("receiving", "127.0.0.1")
    dispatchers.start()
    await assert_whole(stores, upload, content)
    ((_, headers),) = files.asked
    assert (headers["accept-encoding"], "authorization" in headers) == ("identity", False)


async def test_what_breaks_off_goes_on_where_it_stopped(
    stores: Stores, dispatchers: Dispatchers, files: FileServer
):
    upload = await fetch(stores, files.file("/a.jpg", CONTENT, cuts=[5_000_000, 1_000_000]))
    dispatchers.start()
    await assert_whole(stores, upload, CONTENT)
    first, second, third = files.ranges_of("/a.jpg")
    assert (first, second, third) == ("", "bytes=5000000-", "bytes=6000000-")


@pytest.mark.parametrize("etag", ['"one"', None, 'W/"one"'], ids=["no ranges", "no etag", "weak etag"])
async def test_what_cannot_go_on_begins_again_and_leaves_nothing_of_the_old(
    stores: Stores, dispatchers: Dispatchers, files: FileServer, etag: str | None
):
    upload = await fetch(stores, files.file("/a.jpg", CONTENT, cuts=[5_000_000], etag=etag, ranges=not etag))
    dispatchers.start()
    await assert_whole(stores, upload, CONTENT)
    assert len(files.asked) == 2


async def test_a_file_that_changed_meanwhile_is_not_mixed(
    stores: Stores, dispatchers: Dispatchers, files: FileServer
):
    upload = await fetch(stores, files.file("/a.jpg", CONTENT, cuts=[5_000_000]))
    dispatchers.start()
    while (await stores.uploads.get(upload.id)).received == 0:
        await asyncio.sleep(0.01)
    other = CONTENT[::-1]
    files.pages["/a.jpg"].content, files.pages["/a.jpg"].etag = other, '"two"'
    await assert_whole(stores, upload, other)
    assert files.ranges_of("/a.jpg")[1:] == ["bytes=5000000-"]


async def test_a_server_that_is_busy_is_asked_again_and_one_that_refuses_is_not(
    stores: Stores, dispatchers: Dispatchers, files: FileServer
):
    url = files.file("/a.jpg", b"abc", heads=[b"503 Busy", b"429 Slow\r\nRetry-After: 1"])
    busy, began = await fetch(stores, url), time.monotonic()
    expired = await fetch(stores, files.answers("/b.jpg", b"403 Forbidden"))
    dispatchers.start()
    refused = await over(stores, expired)
    assert (refused.state, refused.error.code, refused.error.where) == ("rejected", "fetch_failed", "a.jpg")
    assert "answers 403; a signed address may have expired" in refused.error.detail
    assert not refused.error.retryable
    await assert_whole(stores, busy, b"abc")
    assert time.monotonic() - began >= 1.0, "Retry-After is kept to"
    assert len([path for path, _ in files.asked if path == "/b.jpg"]) == 1


async def test_a_server_that_stays_broken_is_given_up(
    stores: Stores, dispatchers: Dispatchers, files: FileServer, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(fetcher.Fetcher, "rounds_max", 3)
    monkeypatch.setattr(fetcher, "IDLE_S", 0.2)
    monkeypatch.setattr(fetcher, "HEAD_S", 0.2)
    broken = [
        await fetch(stores, files.answers("/silent", None)),
        await fetch(stores, files.file("/stops", CONTENT, pause_s=5.0)),
        await fetch(stores, "http://127.0.0.1:9/a"),
        await fetch(stores, files.answers("/no-http", b"200 OK\r\nX: " + b"y" * 2_000_000)),
    ]
    dispatchers.start()
    errors = [(await over(stores, upload)).error for upload in broken]
    assert [(error.code, error.retryable) for error in errors] == [("fetch_failed", True)] * 4
    assert len([path for path, _ in files.asked if path == "/silent"]) == 3


async def test_a_drip_is_not_waited_for(
    stores: Stores, dispatchers: Dispatchers, files: FileServer, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(fetcher.Fetcher, "rounds_max", 1)
    monkeypatch.setattr(fetcher, "SLOW_S", 0.3)
    monkeypatch.setattr(fetcher, "SLOWEST_BYTES_PER_S", 2e6)
    slow = await fetch(stores, files.file("/slow", CONTENT, pause_s=0.1))
    quick = await fetch(stores, files.file("/quick", CONTENT, pause_s=0.001))
    dispatchers.start()
    assert "is too slow" in (await over(stores, slow)).error.detail
    await assert_whole(stores, quick, CONTENT)


@pytest.mark.parametrize("chunked", [False, True], ids=["said", "unsaid"])
async def test_a_file_beyond_the_limit_is_left_where_it_is(
    stores: Stores, settings: Settings, dispatchers: Dispatchers, files: FileServer, chunked: bool
):
    upload = await fetch(stores, files.file("/a.jpg", CONTENT, chunked=chunked))
    small = settings.model_copy(update={"max_file_bytes": 5_000_000})
    dispatchers.start(small)
    now = await over(stores, upload)
    assert (now.state, now.error.code) == ("rejected", "body_too_large")
    assert now.received < 5_000_000
    assert await addresses(stores) == 0
    assert await content_of(stores, now) == b""


@pytest.mark.parametrize("size", [len(CONTENT) - 1, len(CONTENT) + 1])
@pytest.mark.parametrize("chunked", [False, True], ids=["said", "unsaid"])
async def test_a_file_of_another_size_than_announced_is_rejected(
    stores: Stores, dispatchers: Dispatchers, files: FileServer, chunked: bool, size: int
):
    upload = await fetch(stores, files.file("/a.jpg", CONTENT, chunked=chunked), size=size)
    dispatchers.start()
    assert (await over(stores, upload)).error.code == "digest_mismatch"


async def test_the_quota_counts_what_is_announced_and_what_comes_without(
    stores: Stores, dispatchers: Dispatchers, files: FileServer
):
    await stores.tenants.set("anna", max_stored_bytes=6_000_000)
    annas = (await stores.datasets.for_tenant("anna").create("set")).id
    url = files.file("/a.jpg", CONTENT, chunked=True)
    with pytest.raises(LimitReached) as told:
        await stores.uploads.fetch(annas, [FileAddress(url=url, path="a", size=len(CONTENT))])
    assert told.value.code == "quota_exhausted"
    (upload,) = await stores.uploads.fetch(annas, [FileAddress(url=url, path="a")])
    dispatchers.start()
    assert (await over(stores, upload)).error.code == "quota_exhausted"
    assert (await stores.tenants.share("anna")).stored_bytes == 0


@pytest.mark.parametrize(
    "to",
    [
        "http://169.254.169.254/latest/meta-data/",
        "http://10.0.0.7/",
        "http://[::ffff:169.254.169.254]/",
        "http://0x7f000001/",
        "file:///etc/passwd",
        "http://user@127.0.0.1/",
        "//[fd00:ec2::254]/",
    ],
)
async def test_a_redirect_inside_rejects_the_upload_by_name(
    stores: Stores, dispatchers: Dispatchers, files: FileServer, to: str
):
    upload = await fetch(stores, files.answers("/a.jpg", b"302 Found\r\nLocation: " + to.encode()))
    dispatchers.start()
    now = await over(stores, upload)
    assert (now.state, now.error.code, now.error.where) == ("rejected", "address_refused", "a.jpg")
    assert await addresses(stores) == 0


async def test_redirects_are_followed_to_the_file_but_not_for_ever(
    stores: Stores, dispatchers: Dispatchers, files: FileServer
):
    files.file("/b.jpg", b"abc")
    found = await fetch(stores, files.answers("/a.jpg", b"307 T\r\nLocation: /b.jpg"))
    loop = await fetch(stores, files.answers("/loop", b"301 M\r\nLocation: /loop"))
    dispatchers.start()
    await until(lambda: len(files.asked) >= 8)
    assert "redirects too often" in (await over(stores, loop)).error.detail
    await assert_whole(stores, found, b"abc")
    assert len([path for path, _ in files.asked if path == "/loop"]) == 6


@pytest.mark.parametrize(
    "url",
    ["http://10.0.0.7/a", "ftp://127.0.0.1/a", "http://169.254.169.254/", "x" * 9000, "http://a@127.0.0.1/"],
)
async def test_an_address_that_is_not_allowed_is_refused_at_once_and_no_other_is_taken(
    stores: Stores, files: FileServer, url: str
):
    dataset = await stores.datasets.create("test")
    good = files.file("/a.jpg", b"abc")
    with pytest.raises(InputError) as told:
        await stores.uploads.fetch(
            dataset.id, [FileAddress(url=good, path="a"), FileAddress.model_construct(url=url, path="b/c")]
        )
    assert (told.value.code, told.value.where) == ("address_refused", "b/c")
    assert url[:2000] not in str(told.value)
    assert (await stores.uploads.of_dataset(dataset.id), await addresses(stores)) == ((), 0)


async def test_webhooks_that_may_go_inside_let_no_files_come_from_there(
    stores: Stores, settings: Settings, dispatchers: Dispatchers, files: FileServer
):
    upload = await fetch(stores, files.file("/a.jpg", b"abc"))
    dispatchers.start(settings.model_copy(update={"file_address_networks": ()}))
    assert (await over(stores, upload)).error.code == "address_refused"
    assert files.asked == []


async def test_what_a_killed_dispatcher_fetched_goes_on_and_losses_in_a_row_end_it(
    stores: Stores, settings: Settings, dispatchers: Dispatchers, files: FileServer
):
    upload = await fetch(stores, files.file("/a.jpg", CONTENT, pause_s=0.02))
    database = stores.uploads._database
    # Before the first piece came: a fetch that goes on is not given up for these.
    await database.fetch("UPDATE upload_fetches SET losses = %s", LOSSES_MAX - 1)
    killed = dispatchers.start_process()
    while (await stores.uploads.get(upload.id)).received == 0:
        await asyncio.sleep(0.02)
    killed.kill()
    dispatchers.start()
    await assert_whole(stores, upload, CONTENT)
    first, second = files.ranges_of("/a.jpg")
    assert (first, int(second.removeprefix("bytes=")[:-1]) >= PIECE_MAX_BYTES) == ("", True)
    again = await fetch(stores, files.answers("/deadly", None))
    lost = "UPDATE upload_fetches SET token = %s, leased_until = now(), losses = %s WHERE id = %s"
    await database.fetch(lost, uuid.uuid4(), LOSSES_MAX - 1, again.id)
    assert f"{LOSSES_MAX} processes were lost" in (await over(stores, again)).error.detail


async def test_a_dispatcher_that_ends_leaves_the_file_to_the_next_which_counts_no_loss(
    stores: Stores, settings: Settings, dispatchers: Dispatchers, files: FileServer, slots, tmp_path: Path
):
    upload = await fetch(stores, files.file("/a.jpg", CONTENT, pause_s=0.02))
    first = Dispatchers(settings, slots, tmp_path)
    first.start()
    while (await stores.uploads.get(upload.id)).received == 0:
        await asyncio.sleep(0.02)
    await first.end()
    (row,) = await stores.uploads._database.fetch("SELECT token, losses FROM upload_fetches")
    assert row == {"token": None, "losses": 0}
    dispatchers.start()
    await assert_whole(stores, upload, CONTENT)


async def test_what_no_dispatcher_fetches_is_rejected_in_the_end_and_not_just_gone(
    settings: Settings, files: FileServer
):
    async with open_stores(settings.model_copy(update={"upload_expiry_s": 0.3})) as stores:
        upload = await fetch(stores, files.file("/a.jpg", b"abc"))
        await asyncio.sleep(0.4)
        await stores.uploads.expire()
        now = await stores.uploads.get(upload.id)
        assert (now.state, now.error.code) == ("rejected", "fetch_failed")
        assert await addresses(stores) == 0


async def test_an_upload_that_is_deleted_is_fetched_no_further(
    stores: Stores, dispatchers: Dispatchers, files: FileServer
):
    upload = await fetch(stores, files.file("/a.jpg", CONTENT * 4, pause_s=0.05))
    dispatchers.start()
    await until(lambda: bool(files.asked))
    with pytest.raises(Conflict):
        await stores.uploads.append(upload.id, 0, aiter_of(b"from a client"))
    await stores.uploads.delete(upload.id)
    await asyncio.sleep(1.0)
    with pytest.raises(NotFound):
        await stores.uploads.get(upload.id)
    assert await addresses(stores) == 0
    assert await stores.files.list(f"datasets/{upload.dataset_id}/uploads") == []


async def aiter_of(content: bytes):
    yield content


async def test_no_log_has_more_of_an_address_than_its_host(
    stores: Stores, settings: Settings, dispatchers: Dispatchers, files: FileServer, tmp_path: Path
):
    loud = settings.model_copy(update={"log_level": "DEBUG"})
    good = await fetch(stores, files.file("/folder/a.jpg", b"abc"))
    bad = await fetch(stores, files.answers("/folder/b.jpg", b"404 No"))
    gone = await fetch(stores, "http://127.0.0.1:9/folder/c?X-Amz-Signature=SECRETSIGNATURE")
    with psycopg.connect(settings.require_database_url()) as connection:
        connection.execute("UPDATE upload_fetches SET round = 4 WHERE id = %s", (gone.id,))
    dispatchers._settings = loud
    dispatchers.start_process()
    shown = [(await over(stores, upload)).model_dump_json() for upload in (good, bad, gone)]
    log = (tmp_path / "dispatcher.log").read_text()
    assert "is rejected" in log
    for text in (log, *shown):
        assert "SECRETSIGNATURE" not in text
        assert "/folder/" not in text
