"""An archive is added whole or not at all, and closing a dataset waits for it."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any

import httpx
import pytest

from service.http.dependencies import Service
from tests.service.conftest import problem, zip_of
from tests.service.in_process import serving
from tests.workers.conftest import anyio_backend, database_url, quick_settings, server
from workers.engine import Stores
from workers.settings.errors import Unavailable
from workers.store.files import FileStore
from workers.store.trash import empty_trash

__all__ = ["anyio_backend", "database_url", "server"]
pytestmark = pytest.mark.anyio
PHOTOS = {f"{number}.png": b"%d" % number * 1000 for number in range(6)}


@pytest.fixture
async def http(database_url: str, tmp_path: Path) -> AsyncIterator[httpx.AsyncClient]:
    async with serving(quick_settings(tmp_path / "data", database_url=database_url)) as client:
        yield client


def stores_of(http: httpx.AsyncClient) -> Stores:
    service: Service = http._transport.app.state.service  # type: ignore[attr-defined]
    return service.stores


async def new_dataset(http: httpx.AsyncClient) -> str:
    return str((await http.post("/v1/datasets", json={})).json()["id"])


async def stored_in(http: httpx.AsyncClient, dataset: str) -> set[str]:
    """Keys in the file store once what is garbage is gone."""
    stores = stores_of(http)
    await empty_trash(stores.datasets._database, stores.files)
    return {file.key for file in await stores.files.list(f"datasets/{dataset}")}


async def counted_bytes(http: httpx.AsyncClient, dataset: str) -> int:
    sql = "SELECT stored_bytes FROM datasets WHERE id = %s"
    (row,) = await stores_of(http).datasets._database.fetch(sql, dataset)
    return int(row["stored_bytes"])


async def test_an_archive_beyond_the_quota_leaves_no_file(http: httpx.AsyncClient):
    await stores_of(http).tenants.set("local", max_stored_bytes=3500)
    dataset = await new_dataset(http)
    sent = await http.post(f"/v1/datasets/{dataset}/archive", content=zip_of(PHOTOS))
    problem(sent, 429, "quota_exhausted")
    assert (await http.get(f"/v1/datasets/{dataset}")).json()["files"] == 0
    assert await stored_in(http, dataset) == set()
    assert await counted_bytes(http, dataset) == 0


async def test_an_archive_that_cannot_be_stored_whole_leaves_no_file(
    http: httpx.AsyncClient, monkeypatch: pytest.MonkeyPatch
):
    put, count = FileStore.put, 0

    async def fails_once(self: FileStore, *given: Any, **named: Any) -> Any:
        nonlocal count
        count += 1
        if count == 4:
            raise Unavailable("storage_unavailable", "The store is away.")
        return await put(self, *given, **named)

    monkeypatch.setattr(type(stores_of(http).files), "put", fails_once)
    dataset = await new_dataset(http)
    sent = await http.post(f"/v1/datasets/{dataset}/archive", content=zip_of(PHOTOS))
    problem(sent, 503, "storage_unavailable")
    assert (await http.get(f"/v1/datasets/{dataset}")).json()["files"] == 0
    assert await stored_in(http, dataset) == set()
    again = await http.post(f"/v1/datasets/{dataset}/archive", content=zip_of(PHOTOS))
    assert again.json()["files"] == len(PHOTOS)


async def test_closing_a_dataset_waits_for_the_archive_that_is_being_added(
    http: httpx.AsyncClient, monkeypatch: pytest.MonkeyPatch
):
    put = FileStore.put

    async def slowly(self: FileStore, *given: Any, **named: Any) -> Any:
        await asyncio.sleep(0.3)
        return await put(self, *given, **named)

    dataset = await new_dataset(http)
    assert (await http.put(f"/v1/datasets/{dataset}/files/first.png", content=b"x")).status_code == 201
    monkeypatch.setattr(type(stores_of(http).files), "put", slowly)
    adding = asyncio.create_task(http.post(f"/v1/datasets/{dataset}/archive", content=zip_of(PHOTOS)))
    while not await stores_of(http).datasets.being_imported(dataset):
        await asyncio.sleep(0.02)
    closed = await http.post(f"/v1/datasets/{dataset}/finalize")
    assert (await adding).status_code == 200
    assert (closed.status_code, closed.json()["files"]) == (200, 1 + len(PHOTOS))


async def test_an_import_whose_process_died_keeps_nobody_waiting(http: httpx.AsyncClient):
    dataset = await new_dataset(http)
    await http.put(f"/v1/datasets/{dataset}/files/first.png", content=b"x")
    await stores_of(http).datasets._database.fetch(
        "INSERT INTO dataset_imports VALUES (gen_random_uuid(), %s, clock_timestamp() + interval '1 s')",
        dataset,
    )
    async with asyncio.timeout(30):
        assert (await http.post(f"/v1/datasets/{dataset}/finalize")).status_code == 200


async def test_an_archive_replaces_files_and_what_it_replaced_alone_is_deleted(http: httpx.AsyncClient):
    dataset = await new_dataset(http)
    address = f"/v1/datasets/{dataset}/archive"
    await http.post(address, content=zip_of(PHOTOS))
    changed = {"1.png": b"new", "more/x.png": b"more"}
    assert (await http.post(address, content=zip_of(changed))).json()["files"] == len(PHOTOS) + 1
    expected = {**PHOTOS, **changed}
    listed = (await stores_of(http).datasets.files(dataset)).items
    assert {file.path: file.size for file in listed} == {path: len(text) for path, text in expected.items()}
    assert await stored_in(http, dataset) == {file.key for file in listed}
    for file in listed:
        assert b"".join([part async for part in stores_of(http).files.read(file.key)]) == expected[file.path]
    assert await counted_bytes(http, dataset) == sum(map(len, expected.values()))
    await stores_of(http).datasets.delete(dataset)
    assert await stored_in(http, dataset) == set()
