"""Received uploads are stored eventually, and one that cannot be stored does not block others."""

from __future__ import annotations

from pathlib import Path

import pytest

from service.app import finish_uploads
from service.http.dependencies import Service
from tests.service.conftest import problem
from tests.service.in_process import serving
from tests.workers.conftest import anyio_backend, database_url, quick_settings, server
from workers.engine import Stores

__all__ = ["anyio_backend", "database_url", "server"]
pytestmark = [pytest.mark.server, pytest.mark.anyio]


async def received(stores: Stores, path: str) -> str:
    """An upload of one file, whole."""

    async def content():
        yield b"abc"

    dataset = await stores.datasets.create("test")
    upload = await stores.uploads.create(dataset.id, "file", 3, path=path)
    return (await stores.uploads.append(upload.id, 0, content())).id


async def test_one_upload_that_fails_stops_no_other_and_tells_no_path(
    database_url: str, tmp_path: Path, caplog: pytest.LogCaptureFixture
):
    settings = quick_settings(tmp_path / "data", database_url=database_url)
    async with serving(settings) as http:
        service: Service = http._transport.app.state.service
        stores = service.stores
        poisoned = [await received(stores, "a.png") for _ in range(2)]
        for upload_id in poisoned:
            folder = settings.files_dir / (await stores.uploads.get(upload_id)).folder
            piece = next(folder.iterdir())
            piece.unlink()
            piece.symlink_to(piece)  # neither there nor away: the store cannot say
        good = await received(stores, "b.png")
        await finish_uploads(service)
        assert (await stores.uploads.get(good)).state == "stored"
        assert [(await stores.uploads.get(each)).state for each in poisoned] == ["received"] * 2
        assert caplog.text.count("is received but not stored yet") == 2
        caplog.clear()
        await finish_uploads(service)
        assert "not stored yet" not in caplog.text, "they are tried again later"
        dataset = (await stores.uploads.get(poisoned[0])).dataset_id
        told = problem(await http.post(f"/v1/datasets/{dataset}/finalize"), 503, "storage_unavailable")
        assert str(tmp_path) not in str(told)
