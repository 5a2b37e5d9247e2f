"""Sets fetched from addresses, over HTTP: errors name their file, and finalizing waits for all files."""

from __future__ import annotations

import asyncio
import hashlib
import io
import time
import zipfile
from collections.abc import AsyncIterator
from pathlib import Path

import httpx
import pytest

from tests.service.conftest import problem, zip_of
from tests.service.in_process import serving
from tests.workers.conftest import anyio_backend, database_url, server
from tests.workers.datasets.file_server import FileServer
from tests.workers.webhooks.webhook_receiver import hook_settings
from workers.upkeep.dispatcher import dispatch

__all__ = ["anyio_backend", "database_url", "server"]
pytestmark = [pytest.mark.server, pytest.mark.anyio]
PHOTOS = {"images/a.jpg": b"first", "images/b.jpg": b"second"}


@pytest.fixture
async def files() -> AsyncIterator[FileServer]:
    async with FileServer().open() as opened:
        yield opened


@pytest.fixture
async def http(database_url: str, tmp_path: Path) -> AsyncIterator[httpx.AsyncClient]:
    settings, stop = hook_settings(database_url, tmp_path), asyncio.Event()
    async with serving(settings) as client:
        dispatching = asyncio.create_task(dispatch(settings, stop))
        yield client
        stop.set()
        await dispatching


async def new_dataset(http: httpx.AsyncClient) -> str:
    return (await http.post("/v1/datasets", json={})).json()["id"]


async def fetched(
    http: httpx.AsyncClient, dataset: str, *files: dict[str, object]
) -> list[dict[str, object]]:
    answer = await http.post(f"/v1/datasets/{dataset}/fetches", json={"files": files})
    assert answer.status_code == 202, answer.text
    return answer.json()["items"]


async def paths(http: httpx.AsyncClient, dataset: str) -> list[str]:
    return [item["path"] for item in (await http.get(f"/v1/datasets/{dataset}/files")).json()["items"]]


async def test_finalizing_waits_for_an_archive_and_files_that_come_slowly(
    http: httpx.AsyncClient, files: FileServer
):
    dataset, content = await new_dataset(http), bytes(2**19)
    began = time.monotonic()
    made = await fetched(
        http,
        dataset,
        {"url": files.file("/set.zip", zip_of(PHOTOS))},
        {
            "url": files.file("/c", content, pause_s=0.1),
            "path": "./c.jpg",
            "sha256": hashlib.sha256(content).hexdigest(),
        },
    )
    assert [(item["path"], item["host"]) for item in made] == [(None, "127.0.0.1"), ("c.jpg", "127.0.0.1")]
    done = await http.post(f"/v1/datasets/{dataset}/finalize")
    assert (done.status_code, done.json()["state"]) == (200, "ready")
    assert time.monotonic() - began >= 0.8
    assert await paths(http, dataset) == ["c.jpg", *PHOTOS]
    assert (await http.get(f"/v1/datasets/{dataset}/fetches")).json()["items"] == []
    assert (await http.get(f"/v1/uploads/{made[1]['id']}")).json()["state"] == "stored"


async def test_without_anybody_who_waits_files_come_into_the_dataset_too(
    http: httpx.AsyncClient, files: FileServer
):
    dataset = await new_dataset(http)
    await fetched(http, dataset, {"url": files.file("/a", b"abc"), "path": "a.jpg"})
    async with asyncio.timeout(10):
        while await paths(http, dataset) != ["a.jpg"]:
            await asyncio.sleep(0.05)


def bomb() -> bytes:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("a.jpg", b"good")
        archive.writestr("b.jpg", bytes(300 * 2**20))
    return buffer.getvalue()


@pytest.mark.parametrize(
    ("content", "code"),
    [
        pytest.param(bomb(), "archive_too_large", id="bomb"),
        pytest.param(zip_of(PHOTOS | {"../evil": b"x"}), "unsafe_path", id="path outside"),
        pytest.param(zip_of(PHOTOS)[:-20], "archive_rejected", id="cut short"),
        pytest.param(b"<html>Sign in</html>", "archive_rejected", id="a page"),
    ],
)
async def test_an_archive_that_cannot_be_unpacked_leaves_no_file_and_is_said(
    http: httpx.AsyncClient, files: FileServer, content: bytes, code: str
):
    dataset = await new_dataset(http)
    (made,) = await fetched(http, dataset, {"url": files.file("/set.zip", content)})
    status = 413 if code == "archive_too_large" else 422
    told = problem(await http.post(f"/v1/datasets/{dataset}/finalize"), status, code)
    assert f"DELETE /v1/uploads/{made['id']}" in told["hint"]
    assert await paths(http, dataset) == []


@pytest.mark.parametrize("path", [None, "images/a.jpg"], ids=["archive", "file"])
async def test_other_bytes_than_announced_are_rejected_by_name(
    http: httpx.AsyncClient, files: FileServer, path: str | None
):
    dataset = await new_dataset(http)
    url = files.file("/a", zip_of(PHOTOS))
    await fetched(http, dataset, {"url": url, "path": path, "sha256": 64 * "0"})
    told = problem(await http.post(f"/v1/datasets/{dataset}/finalize"), 422, "digest_mismatch")
    assert "DELETE /v1/uploads/up_" in told["hint"]
    (rejected,) = (await http.get(f"/v1/datasets/{dataset}/fetches")).json()["items"]
    assert (rejected["state"], rejected["path"]) == ("rejected", path)
    assert await paths(http, dataset) == []


async def test_one_file_that_does_not_come_ends_the_waiting_and_can_be_replaced(
    http: httpx.AsyncClient, files: FileServer
):
    dataset = await new_dataset(http)
    (bad, _) = await fetched(
        http,
        dataset,
        {"url": files.answers("/a", b"404 Not Found"), "path": "images/a.jpg"},
        {"url": files.answers("/silent", None), "path": "b.jpg"},
    )
    told = problem(await http.post(f"/v1/datasets/{dataset}/finalize"), 422, "fetch_failed")
    assert (told["where"], told["detail"]) == ("images/a.jpg", "127.0.0.1 answers 404.")
    assert "SECRET" not in str(told)
    for item in (await http.get(f"/v1/datasets/{dataset}/fetches")).json()["items"]:
        gone = await http.delete(f"/v1/uploads/{item['id']}", headers={"Tus-Resumable": "1.0.0"})
        assert gone.status_code == 204
    await fetched(http, dataset, {"url": files.file("/a", b"abc"), "path": bad["path"]})
    assert (await http.post(f"/v1/datasets/{dataset}/finalize")).json()["state"] == "ready"
    assert await paths(http, dataset) == ["images/a.jpg"]


async def test_addresses_inside_and_unsafe_names_are_refused_with_the_request(http: httpx.AsyncClient):
    dataset = await new_dataset(http)
    address = f"/v1/datasets/{dataset}/fetches"
    for url in ("http://192.168.0.1/?token=SECRET", "http://169.254.169.254/SECRET", "s3://bucket/SECRET"):
        answer = await http.post(address, json={"files": [{"url": url, "path": "a/b.jpg"}]})
        told = problem(answer, 422, "address_refused")
        assert told["where"] == "a/b.jpg"
        assert "SECRET" not in answer.text
    answer = await http.post(address, json={"files": [{"url": "http://127.0.0.1:9/", "path": "../b"}]})
    problem(answer, 422, "unsafe_path")
    answer = await http.post(address, json={"files": [{"url": "SECRET" * 2000}]})
    problem(answer, 422, "invalid_request")
    assert "SECRET" not in answer.text
    assert (await http.get(address)).json()["items"] == []
