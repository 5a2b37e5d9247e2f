"""Uploads in pieces, over several processes."""

from __future__ import annotations

import asyncio
import uuid
from collections.abc import AsyncIterator
from pathlib import Path

import pytest

from biresnerf.wire.problems import JobError
from tests.workers.buckets import environment_of, fresh_bucket, moto_server
from tests.workers.conftest import quick_settings
from workers.engine import Stores, open_stores
from workers.records import Upload
from workers.settings.errors import Conflict, LimitReached, NotFound
from workers.settings.settings import Settings

pytestmark = pytest.mark.anyio
CONTENT = bytes(range(256)) * 40_000  # 10 MB: three pieces


async def stream(content: bytes, breaks: bool = False) -> AsyncIterator[bytes]:
    for start in range(0, len(content), 65536):
        yield content[start : start + 65536]
    if breaks:
        raise ConnectionError("gone")


async def begin(stores: Stores, size: int = len(CONTENT)) -> Upload:
    dataset = await stores.datasets.create("test")
    return await stores.uploads.create(dataset.id, "archive", size)


async def content_of(stores: Stores, upload: Upload) -> bytes:
    return b"".join([chunk async for chunk in stores.uploads.content(upload)])


async def test_of_two_connections_at_one_place_one_wins(stores: Stores):
    upload = await begin(stores)
    appends = [stores.uploads.append(upload.id, 0, stream(CONTENT)) for _ in range(3)]
    outcomes = await asyncio.gather(*appends, return_exceptions=True)
    lost = [outcome for outcome in outcomes if isinstance(outcome, Conflict)]
    assert len(lost) == 2
    assert {error.code for error in lost} == {"offset_mismatch"}
    assert (await stores.uploads.get(upload.id)).state == "received"
    assert await content_of(stores, upload) == CONTENT
    pieces = await stores.files.list(upload.folder)
    assert sum(piece.size for piece in pieces) == len(CONTENT)  # the losers left nothing


async def test_what_came_before_a_break_is_kept_and_nothing_beyond_the_end(stores: Stores):
    upload = await begin(stores)
    with pytest.raises(ConnectionError):
        await stores.uploads.append(upload.id, 0, stream(CONTENT[:5_000_001], breaks=True))
    assert (await stores.uploads.get(upload.id)).received == 5_000_001
    with pytest.raises(LimitReached):
        await stores.uploads.append(upload.id, 5_000_001, stream(CONTENT[5_000_001:] + b"more"))
    kept = (await stores.uploads.get(upload.id)).received
    assert kept <= len(CONTENT)
    await stores.uploads.append(upload.id, kept, stream(CONTENT[kept:]))
    assert await content_of(stores, upload) == CONTENT


async def test_an_upload_goes_on_through_another_replica_with_a_bucket(settings: Settings, tmp_path: Path):
    with moto_server() as address:
        bucket = environment_of(fresh_bucket(address))
        one, other = (
            quick_settings(tmp_path / host, database_url=settings.database_url, **bucket) for host in "ab"
        )
        async with open_stores(one) as here, open_stores(other) as there:
            upload = await begin(here)
            await here.uploads.append(upload.id, 0, stream(CONTENT[:6_000_000]))
            done = await there.uploads.append(upload.id, 6_000_000, stream(CONTENT[6_000_000:]))
            assert (done.state, done.received) == ("received", len(CONTENT))
            assert await content_of(here, upload) == CONTENT
        assert not one.files_dir.exists()
        assert not other.files_dir.exists()


async def test_one_taker_at_a_time_and_a_dead_one_is_replaced(stores: Stores, settings: Settings):
    upload = await begin(stores, 3)
    first, second = uuid.uuid4(), uuid.uuid4()
    assert not await stores.uploads.take(upload.id, first)  # nothing has arrived
    await stores.uploads.append(upload.id, 0, stream(b"abc"))
    assert await stores.uploads.not_imported() == (upload.id,)
    assert await stores.uploads.take(upload.id, first)
    assert not await stores.uploads.take(upload.id, second)
    assert await stores.uploads.not_imported() == ()
    await asyncio.sleep(2 * settings.beat_s + 0.1)
    assert await stores.uploads.take(upload.id, second)
    await stores.uploads.conclude(upload.id, first, JobError(code="late", detail="from the grave"))
    await stores.uploads.conclude(upload.id, second, None)
    assert (await stores.uploads.get(upload.id)).state == "stored"
    assert await stores.uploads.of_dataset(upload.dataset_id) == ()


async def test_what_does_not_go_on_is_given_up(settings: Settings, tmp_path: Path):
    hasty = quick_settings(settings.data_dir, database_url=settings.database_url, upload_expiry_s=0.5)
    async with open_stores(hasty) as stores:
        old, received = await begin(stores), await begin(stores, 3)
        await stores.uploads.append(received.id, 0, stream(b"abc"))
        await asyncio.sleep(0.6)
        young = await begin(stores)
        assert await stores.uploads.expire() == 1
        with pytest.raises(NotFound):
            await stores.uploads.get(old.id)
        assert (await stores.uploads.get(received.id)).state == "rejected"
        assert (await stores.uploads.get(young.id)).state == "receiving"
        await stores.datasets.delete(young.dataset_id)
        with pytest.raises(NotFound):
            await stores.uploads.get(young.id)


async def test_lost_pieces_are_said_and_not_taken_for_a_deleted_upload(stores: Stores):
    upload = await begin(stores)
    upload = await stores.uploads.append(upload.id, 0, stream(CONTENT))
    lost = (await stores.files.list(upload.folder))[1].key
    await stores.files.delete(lost)
    with pytest.raises(Conflict) as caught:
        await content_of(stores, upload)
    assert caught.value.code == "upload_incomplete"


async def taken(stores: Stores, upload: Upload, files: dict[str, bytes]) -> None:
    """What the web process does with a received upload that holds these files."""
    token = uuid.uuid4()
    assert await stores.uploads.take(upload.id, token)
    for path, content in files.items():
        await stores.datasets.add_file(upload.dataset_id, path, stream(content), upload_id=upload.id)
    await stores.uploads.conclude(upload.id, token, None)


async def stored(stores: Stores) -> int:
    return (await stores.tenants.share("anna")).stored_bytes


async def test_an_upload_that_fills_the_quota_is_brought_in_and_counted_once(stores: Stores):
    await stores.tenants.set("anna", max_stored_bytes=1000)
    dataset = await stores.datasets.for_tenant("anna").create("full")
    upload = await stores.uploads.create(dataset.id, "file", 1000, path="a.png")
    upload = await stores.uploads.append(upload.id, 0, stream(bytes(1000)))
    assert await stored(stores) == 1000
    # The process died when the file was stored, before it said so: the next one does it again.
    await stores.datasets.add_file(dataset.id, "a.png", stream(bytes(1000)), upload_id=upload.id)
    assert await stored(stores) == 1000
    await taken(stores, upload, {"a.png": bytes(1000)})
    assert await stored(stores) == 1000


async def test_what_an_archive_unpacks_to_is_counted_and_the_archive_only_until_then(stores: Stores):
    await stores.tenants.set("anna", max_stored_bytes=1500)
    dataset = await stores.datasets.for_tenant("anna").create("packed")
    upload = await stores.uploads.create(dataset.id, "archive", 1000)
    upload = await stores.uploads.append(upload.id, 0, stream(bytes(1000)))
    await stores.datasets.add_file(dataset.id, "a.png", stream(bytes(400)), upload_id=upload.id)
    assert await stored(stores) == 1000, "400 in the dataset, 600 for the rest"
    with pytest.raises(LimitReached) as refused:
        await stores.datasets.add_file(dataset.id, "b.png", stream(bytes(1200)), upload_id=upload.id)
    assert refused.value.code == "quota_exhausted"
    assert (await stored(stores), (await stores.datasets.get(dataset.id)).files) == (1000, 1)
    await taken(stores, upload, {"a.png": bytes(400), "b.png": bytes(1100)})
    assert await stored(stores) == 1500


async def test_what_could_not_be_stored_waits_longer_each_time_and_is_rejected_in_the_end(
    settings: Settings,
):
    hasty = quick_settings(settings.data_dir, database_url=settings.database_url, upload_expiry_s=0.5)
    async with open_stores(hasty) as stores:
        upload = await begin(stores, 3)
        await stores.uploads.append(upload.id, 0, stream(b"abc"))
        token = uuid.uuid4()
        assert await stores.uploads.take(upload.id, token)
        await stores.uploads.give_back(upload.id, token, failed=True)
        assert await stores.uploads.not_imported() == ()
        again = uuid.uuid4()
        assert await stores.uploads.take(upload.id, again), "who asks for it need not wait"
        await asyncio.sleep(0.6)
        assert await stores.uploads.take(upload.id, again)
        await stores.uploads.expire()
        assert (await stores.uploads.get(upload.id)).state == "received", "somebody is at it"
        await stores.uploads.give_back(upload.id, again, failed=True)
        await stores.uploads.expire()
        given_up = await stores.uploads.get(upload.id)
        assert given_up.state == "rejected"
        assert given_up.error.code == "storage_unavailable"
        assert await content_of(stores, given_up) == b""
        await asyncio.sleep(0.6)
        assert await stores.uploads.expire() == 1
