"""Connections that are dead while both ends live, and living workers that counted as dead."""

from __future__ import annotations

import asyncio
import os
import signal
from collections.abc import AsyncIterator
from pathlib import Path
from urllib.parse import quote

import pytest
from psycopg.conninfo import conninfo_to_dict

from tests.workers.conftest import Counting, Slots, short_folder
from workers.settings.settings import Settings

pytestmark = pytest.mark.anyio
SOCKET = ".s.PGSQL.5432"


class Line:
    """A way to the database on which connections can fall silent: no byte more, and no end."""

    def __init__(self, folder: Path, url: str) -> None:
        real = str(conninfo_to_dict(url)["host"])
        self._folder, self._real = folder, real
        self.url = url.replace(quote(real, safe=""), quote(str(folder), safe=""))
        assert self.url != url
        self._moves: list[asyncio.Task[None]] = []
        self._ends: list[asyncio.StreamWriter] = []

    async def open(self) -> asyncio.Server:
        server = await asyncio.start_unix_server(self._connected, self._folder / SOCKET)
        os.chmod(self._folder / SOCKET, 0o777)
        return server

    async def _connected(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        far_reader, far_writer = await asyncio.open_unix_connection(f"{self._real}/{SOCKET}")
        self._ends += [writer, far_writer]
        self._moves += [
            asyncio.create_task(_move(reader, far_writer)),
            asyncio.create_task(_move(far_reader, writer)),
        ]

    def fall_silent(self) -> None:
        """All connections that there are; new ones work."""
        for move in self._moves:
            move.cancel()
        self._moves.clear()

    def close(self) -> None:
        self.fall_silent()
        for end in self._ends:
            end.close()


async def _move(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
    while data := await reader.read(2**16):
        writer.write(data)
        await writer.drain()
    writer.close()


@pytest.fixture
async def line(database_url: str) -> AsyncIterator[Line]:
    with short_folder() as folder:
        opened = Line(folder, database_url)
        server = await opened.open()
        yield opened
        server.close()
        opened.close()


async def test_a_worker_whose_connections_fall_silent_makes_new_ones_and_keeps_its_job(
    counting: Counting, settings: Settings, slots: Slots, line: Line
):
    patient = settings.model_copy(update={"stall_s": 4.5, "answer_s": 1.5})
    slots.start(patient.model_copy(update={"database_url": line.url}), "a")
    await counting.submit(150, 0.05)
    await counting.until(lambda job: job.progress.step >= 10)
    slots.start(patient, "b")  # would take it
    line.fall_silent()
    job = await counting.until_final(timeout_s=60)
    assert (job.state, job.attempt, len(counting.starts())) == ("succeeded", 1, 1)
    await counting.submit(3, 0.01)
    assert (await counting.until_final()).state == "succeeded"


async def test_a_worker_struck_off_while_it_was_frozen_takes_the_next_job(
    counting: Counting, settings: Settings, slots: Slots
):
    worker = slots.start(settings, "a")
    await counting.submit(3, 0.01)
    assert (await counting.until_final()).state == "succeeded"
    os.kill(worker.pid, signal.SIGSTOP)
    await counting.stores.jobs._database.fetch("DELETE FROM procrastinate_workers")
    os.kill(worker.pid, signal.SIGCONT)
    await asyncio.sleep(2 * settings.beat_s)
    await counting.submit(3, 0.01)
    assert (await counting.until_final()).state == "succeeded"
    assert worker.poll() is None


async def test_a_job_that_takes_longer_to_stop_than_the_stall_time_is_not_taken_away(
    counting: Counting, settings: Settings, slots: Slots
):
    slow = settings.model_copy(update={"stop_grace_s": 2.5 * settings.stall_s})
    first = slots.start(slow, "a")
    await counting.submit(110, 0.05, deaf=True)
    await counting.until(lambda job: job.progress.step >= 5)
    slots.start(settings, "b")
    first.terminate()
    while first.poll() is None:
        assert len(counting.starts()) == 1, "two processes work on one job"
        await asyncio.sleep(0.02)
    job = await counting.until_final()
    assert (job.state, job.attempt, len(counting.starts())) == ("succeeded", 1, 2)
