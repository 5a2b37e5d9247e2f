"""Concurrent uploads: how many a key may send, and how received ones wait their turn."""

from __future__ import annotations

import asyncio
import uuid
from contextlib import AsyncExitStack
from pathlib import Path
from typing import Any

import pytest

from service.http.dependencies import Service
from tests.service.conftest import problem, zip_of
from tests.service.in_process import serving
from tests.workers.conftest import anyio_backend, database_url, quick_settings, server

__all__ = ["anyio_backend", "database_url", "server"]
pytestmark = pytest.mark.anyio


async def test_beyond_its_places_a_key_is_told_to_wait_whichever_way_it_sends(
    database_url: str, tmp_path: Path
):
    settings = quick_settings(
        tmp_path / "data", database_url=database_url, auth="required", key_uploads=1, max_file_bytes=10
    )
    async with serving(settings) as http:
        service: Service = http._transport.app.state.service
        keys = [await service.stores.keys.create("anna", name, ["admin"]) for name in ("mine", "other")]
        mine, other = ({"Authorization": f"Bearer {text}"} for _, text in keys)
        http.headers.update(mine)
        dataset = (await http.post("/v1/datasets", json={})).json()["id"]
        files = f"/v1/datasets/{dataset}/files"
        tus = {"Tus-Resumable": "1.0.0", "Upload-Length": "5", "Upload-Offset": "0"}
        begun = await http.post(f"/v1/datasets/{dataset}/uploads", headers=tus)
        more = {**tus, "Content-Type": "application/offset+octet-stream"}
        archive = zip_of({"a": b"x"})
        go_on, under_way = asyncio.Event(), asyncio.Event()

        async def slowly():
            under_way.set()
            yield b"x"
            await go_on.wait()

        first = asyncio.create_task(http.put(f"{files}/first", content=slowly()))
        await under_way.wait()
        for answer in [
            await http.put(f"{files}/a", content=b"x"),
            await http.post(f"/v1/datasets/{dataset}/archive", content=archive),
            await http.post("/v1/jobs", files={"archive": archive}),
            await http.patch(begun.headers["location"], headers=more, content=b"12345"),
        ]:
            told = problem(answer, 429, "too_many_uploads")
            assert (told["retryable"], "retry-after" in answer.headers) == (True, True)
        assert (await http.put(f"{files}/b", content=b"x", headers=other)).status_code == 201
        assert (await http.get(files)).status_code == 200
        go_on.set()
        assert (await first).status_code == 201
        # Each place comes back, also where the body was refused.
        problem(await http.put(f"{files}/large", content=b"x" * 11), 413, "body_too_large")
        problem(await http.post(f"/v1/datasets/{dataset}/archive", content=b"?"), 422, "archive_rejected")
        sent = await http.patch(begun.headers["location"], headers=more, content=b"12345")
        assert sent.status_code == 204


async def lease(service: Service, upload: str) -> dict[str, Any]:
    sql = "SELECT take_token, take_until FROM uploads WHERE id = %s"
    (row,) = await service.stores.uploads._database.fetch(sql, upload)
    return row


async def test_an_archive_that_waits_for_its_turn_stays_its_takers(database_url: str, tmp_path: Path):
    settings = quick_settings(tmp_path / "data", database_url=database_url, beat_s=1.0, stall_s=3.0)
    archive = zip_of({"a": b"x"})
    async with serving(settings) as http:
        service: Service = http._transport.app.state.service
        dataset = (await http.post("/v1/datasets", json={})).json()["id"]
        tus = {"Tus-Resumable": "1.0.0", "Upload-Length": str(len(archive)), "Upload-Offset": "0"}
        begun = await http.post(f"/v1/datasets/{dataset}/uploads", headers=tus)
        address = begun.headers["location"]
        async with AsyncExitStack() as busy:
            for _ in range(service.memory.unpacks):
                await busy.enter_async_context(service.unpacking.turn("other"))
            more = {**tus, "Content-Type": "application/offset+octet-stream"}
            assert (await http.patch(address, headers=more, content=archive)).status_code == 204
            upload = begun.json()["id"]
            while await service.stores.uploads.not_imported():
                await asyncio.sleep(0.02)
            taken = renewed = await lease(service, upload)
            async with asyncio.timeout(20):
                while renewed["take_until"] == taken["take_until"]:
                    await asyncio.sleep(0.05)
                    renewed = await lease(service, upload)
            assert renewed["take_token"] == taken["take_token"]
            assert not await service.stores.uploads.take(upload, uuid.uuid4())
            assert (await http.get(f"/v1/datasets/{dataset}")).json()["files"] == 0
        while (await http.get(address)).json()["state"] != "stored":
            await asyncio.sleep(0.05)
        assert (await http.get(f"/v1/datasets/{dataset}")).json()["files"] == 1
