"""Work that the web process finishes itself: trash and tallies without workers, and abandoned checks."""

from __future__ import annotations

import asyncio
from pathlib import Path

import pytest

from service.app import finish_checks
from service.http.dependencies import Service
from tests.service.in_process import serving
from tests.workers.conftest import anyio_backend, database_url, quick_settings, server

__all__ = ["anyio_backend", "database_url", "server"]
pytestmark = [pytest.mark.server, pytest.mark.anyio]


async def test_trash_and_tallies_do_not_pile_up_without_workers(database_url: str, tmp_path: Path):
    async with serving(quick_settings(tmp_path / "data", database_url=database_url)) as http:
        dataset = (await http.post("/v1/datasets", json={})).json()["id"]
        assert (await http.put(f"/v1/datasets/{dataset}/files/a.png", content=b"x")).status_code == 201
        assert (await http.delete(f"/v1/datasets/{dataset}")).status_code == 204
        service: Service = http._transport.app.state.service
        rows = "SELECT (SELECT count(*) FROM trash) + (SELECT count(*) FROM tally_log) AS left_over"
        async with asyncio.timeout(60):
            while (await service.stores.jobs._database.fetch(rows))[0]["left_over"]:
                await asyncio.sleep(0.2)
        assert not list((tmp_path / "data" / "files").rglob("a.png"))


async def test_one_check_that_cannot_be_made_stops_no_other(
    database_url: str, tmp_path: Path, caplog: pytest.LogCaptureFixture
):
    settings = quick_settings(tmp_path / "data", database_url=database_url)
    async with serving(settings) as http:
        service: Service = http._transport.app.state.service
        left = []  # as by a process that was killed
        for name in ("a.png", "b.png"):
            dataset = (await http.post("/v1/datasets", json={})).json()["id"]
            assert (await http.put(f"/v1/datasets/{dataset}/files/{name}", content=b"x")).status_code == 201
            await service.stores.datasets.finalize(dataset)
            left.append(dataset)
        stored = next((tmp_path / "data" / "files" / "datasets" / left[0]).rglob("a.png*"))
        stored.unlink()
        stored.symlink_to(stored)  # neither there nor away: the store cannot say
        await finish_checks(service)
        states = [(await service.stores.datasets.get(dataset)).state for dataset in left]
        assert states == ["finalizing", "ready"]
        assert f"dataset {left[0]} is not checked yet" in caplog.text
