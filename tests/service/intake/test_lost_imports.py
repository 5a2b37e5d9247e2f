"""An upload that kills web processes is given up; unrelated kills and restarts do not count."""

from __future__ import annotations

import asyncio
import sys
import time
from pathlib import Path

import pytest

from service.http.dependencies import Service
from service.intake.archive_import import start_import
from tests.service.conftest import zip_of
from tests.service.in_process import serving
from tests.workers.conftest import (
    PATIENCE_S,
    anyio_backend,
    database_url,
    environment,
    quick_settings,
    server,
)
from workers.database.losses import LOSSES_MAX
from workers.engine import Stores, open_stores
from workers.records import Upload
from workers.settings.settings import Settings

__all__ = ["anyio_backend", "database_url", "server"]
pytestmark = [pytest.mark.server, pytest.mark.anyio]
PHOTOS = {f"{number}.png": b"%d" % number * 1000 for number in range(6)}
# One web process after the other takes the upload, each killed in the phase that is named; the last is not.
WEB_PROCESSES = """
import asyncio, os, signal, sys
from service.app import create_app
from service.intake import archive_import
from workers.datasets.datasets import DatasetStore
from workers.settings.settings import Settings

UPLOAD, *KILLED = sys.argv[1:]
PLACES = {
    "arriving": (archive_import, "write_stream"),
    "unpacking": (archive_import, "run_confined"),
    "storing": (DatasetStore, "add_files"),
}

def killed(*_, **__):
    os.kill(os.getpid(), signal.SIGKILL)

async def work():
    app = create_app(Settings())
    async with app.router.lifespan_context(app):
        uploads = app.state.service.stores.uploads
        while (await uploads.get(UPLOAD)).state == "received":
            await asyncio.sleep(0.02)

for phase in [*KILLED, None]:
    pid = os.fork()
    if not pid:
        if phase:
            setattr(*PLACES[phase], killed)
        try:
            asyncio.run(work())
        finally:
            os._exit(0)
    os.waitpid(pid, 0)
"""


def quick(database_url: str, tmp_path: Path) -> Settings:
    return quick_settings(tmp_path / "data", database_url=database_url, beat_s=0.1, poll_s=0.05)


async def received(stores: Stores) -> str:
    """An archive, whole."""
    archive = zip_of(PHOTOS)

    async def content():
        yield archive

    dataset = await stores.datasets.create("test")
    upload = await stores.uploads.create(dataset.id, "archive", len(archive))
    return (await stores.uploads.append(upload.id, 0, content())).id


async def losses(stores: Stores) -> int:
    (row,) = await stores.uploads._database.fetch("SELECT losses FROM uploads")
    return int(row["losses"])


async def after_kills(settings: Settings, phases: list[str]) -> tuple[Upload, int]:
    """The upload, and how many files its dataset has, once a process came to its end with it."""
    async with open_stores(settings) as stores:
        upload = await received(stores)
        command = [sys.executable, "-c", WEB_PROCESSES, upload, *phases]
        process = await asyncio.create_subprocess_exec(*command, env=environment(settings))
        assert await process.wait() == 0
        now = await stores.uploads.get(upload)
        return now, (await stores.datasets.get(now.dataset_id)).files


@pytest.mark.parametrize("survived", [True, False], ids=["one less", "too many"])
async def test_an_archive_that_takes_web_processes_down_is_given_up(
    database_url: str, tmp_path: Path, survived: bool
):
    kills = LOSSES_MAX - survived
    upload, files = await after_kills(quick(database_url, tmp_path), ["unpacking"] * kills)
    if survived:
        assert (upload.state, files) == ("stored", len(PHOTOS))
    else:
        assert (upload.state, files) == ("rejected", 0)
        assert upload.error.code == "validation_resources"
        assert f"{LOSSES_MAX} processes were lost" in upload.error.detail


@pytest.mark.nightly  # a minute
async def test_ninety_kills_that_an_archive_has_no_part_in_do_not_reject_it(
    database_url: str, tmp_path: Path
):
    # Now and again one of them hits while it is unpacked; the next unpacks it, and is killed later.
    storm = ["arriving", *["unpacking"] * (LOSSES_MAX - 1), "storing", "storing"] * 15
    assert len(storm) == 90
    upload, files = await after_kills(quick(database_url, tmp_path), storm)
    assert (upload.state, files) == ("stored", len(PHOTOS))


async def test_a_web_process_that_stops_gives_an_archive_back_at_once_and_is_no_loss(
    database_url: str, tmp_path: Path
):
    settings = quick_settings(
        tmp_path / "data", database_url=database_url, beat_s=60.0, poll_s=60.0, stall_s=150.0
    )
    async with open_stores(settings) as stores:
        upload, end = await received(stores), time.monotonic() + PATIENCE_S
        for _ in range(LOSSES_MAX + 1):
            async with serving(settings) as http:
                service: Service = http._transport.app.state.service
                start_import(service, upload)
                while await losses(stores) == 0:
                    assert time.monotonic() < end, "it is being unpacked"
                    await asyncio.sleep(0.005)
            assert await stores.uploads.not_imported() == (upload,)
            assert await losses(stores) == 0
