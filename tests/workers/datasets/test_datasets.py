"""Datasets: files in, limits, checking, deleting."""

from __future__ import annotations

import hashlib
from collections.abc import AsyncIterator

import pytest

from biresnerf.errors import InputError
from biresnerf.options.refine_options import RefineOptions
from biresnerf.wire.datasets import ManifestEntry
from tests.workers.conftest import quick_settings, ready_dataset
from workers.engine import Stores, open_stores
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
