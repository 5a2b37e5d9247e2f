"""When the disk is nearly full, requests are refused before it fills up."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.service.conftest import problem, zip_of
from tests.service.in_process import serving
from tests.workers.conftest import anyio_backend, database_url, quick_settings, server

__all__ = ["anyio_backend", "database_url", "server"]
pytestmark = pytest.mark.anyio
TUS = {"Tus-Resumable": "1.0.0"}


async def test_every_way_in_answers_507_while_the_reserve_is_used(database_url: str, tmp_path: Path):
    async with serving(quick_settings(tmp_path / "data", database_url=database_url)) as roomy:
        dataset = (await roomy.post("/v1/datasets", json={})).json()["id"]
        begun = await roomy.post(f"/v1/datasets/{dataset}/uploads", headers={**TUS, "Upload-Length": "5"})
        upload = begun.headers["location"]
        offset = {**TUS, "Upload-Offset": "0", "Content-Type": "application/offset+octet-stream"}
    full = quick_settings(tmp_path / "data", database_url=database_url, disk_reserve_bytes=2**60)
    archive = zip_of({"a": b"x"})

    async def unannounced():
        yield b"x"

    async with serving(full) as http:
        for answer in [
            await http.put(f"/v1/datasets/{dataset}/files/a", content=b"x"),
            await http.put(f"/v1/datasets/{dataset}/files/a", content=unannounced()),
            await http.post(f"/v1/datasets/{dataset}/archive", content=archive),
            await http.post("/v1/jobs", files={"archive": archive}),
            await http.post(f"/v1/datasets/{dataset}/uploads", headers={**TUS, "Upload-Length": "5"}),
            await http.patch(upload, headers=offset, content=b"12345"),
        ]:
            told = problem(answer, 507, "storage_full")
            assert (told["retryable"], "retry-after" in answer.headers) == (True, True)
        assert (await http.get(f"/v1/datasets/{dataset}")).json()["files"] == 0
        assert (await http.get("/readyz")).status_code == 200  # results can still be fetched
    async with serving(quick_settings(tmp_path / "data", database_url=database_url)) as roomy:
        assert (await roomy.patch(upload, headers=offset, content=b"12345")).status_code == 204
