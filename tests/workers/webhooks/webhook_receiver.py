"""A real receiver of webhooks, and dispatchers as tasks or as processes that can be killed."""

from __future__ import annotations

import asyncio
import contextlib
import json
import subprocess
import sys
import time
from collections.abc import AsyncIterator, Callable
from dataclasses import dataclass, field
from pathlib import Path

from biresnerf.options.refine_options import RefineOptions
from biresnerf.wire.webhooks import DeliveryView
from tests.workers.conftest import Slots, quick_settings, ready_dataset
from workers.engine import Stores
from workers.settings.settings import Settings
from workers.upkeep.dispatcher import dispatch

PATIENCE_S = 20.0


@dataclass
class Message:
    headers: dict[str, str]
    body: bytes
    at: float = field(default_factory=time.monotonic)

    @property
    def data(self) -> dict[str, object]:
        return json.loads(self.body)["data"]


class Receiver:
    """A real HTTP server; ``answers`` are given in turn, the last one for ever. None: silence."""

    def __init__(self, *answers: bytes | None) -> None:
        self.answers, self.messages = list(answers or (b"204 No Content",)), list[Message]()
        self.url, self._held = "", asyncio.Event()

    async def hear(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        try:
            head = (await reader.readuntil(b"\r\n\r\n")).decode()
            headers = {
                name.lower(): value for name, _, value in (line.partition(": ") for line in head.splitlines())
            }
            body = await reader.readexactly(int(headers["content-length"]))
            self.messages.append(Message(headers, body))
            answer = self.answers.pop(0) if len(self.answers) > 1 else self.answers[0]
            if answer is None:
                await self._held.wait()
            else:
                writer.write(b"HTTP/1.1 " + answer + b"\r\nContent-Length: 0\r\n\r\n")
                await writer.drain()
        except (ConnectionError, asyncio.IncompleteReadError):
            pass
        finally:
            writer.close()

    @contextlib.asynccontextmanager
    async def open(self) -> AsyncIterator[Receiver]:
        server = await asyncio.start_server(self.hear, "127.0.0.1", 0)
        self.url = f"http://127.0.0.1:{server.sockets[0].getsockname()[1]}/in"
        try:
            yield self
        finally:
            self._held.set()
            server.close()

    async def heard(self, count: int) -> list[Message]:
        await until(lambda: len(self.messages) >= count)
        return self.messages

    def events(self) -> list[str]:
        return [json.loads(message.body)["type"] for message in self.messages]


async def until(holds: Callable[[], bool]) -> None:
    end = time.monotonic() + PATIENCE_S
    while not holds():
        assert time.monotonic() < end, "waited too long"
        await asyncio.sleep(0.02)


def hook_settings(database_url: str, tmp_path: Path) -> Settings:
    """Receivers and senders of files live on this machine, and are asked again soon."""
    return quick_settings(
        tmp_path / "data",
        database_url=database_url,
        webhook_http=True,
        webhook_ports=(),
        webhook_networks=("127.0.0.0/8",),
        file_address_http=True,
        file_address_ports=(),
        file_address_networks=("127.0.0.0/8",),
        webhook_retry_s=0.1,
        webhook_timeout_s=1.0,
    )


class Dispatchers:
    """Starts dispatchers: within this process (it is the same program), or as processes that can be killed."""

    def __init__(self, settings: Settings, slots: Slots, folder: Path) -> None:
        self._settings, self._slots, self._folder = settings, slots, folder
        self._stop, self._tasks = asyncio.Event(), list[asyncio.Task[None]]()

    def start(self, settings: Settings | None = None) -> None:
        self._tasks.append(asyncio.create_task(dispatch(settings or self._settings, self._stop)))

    def start_process(self) -> subprocess.Popen[bytes]:
        command = [sys.executable, "-m", "workers.upkeep.dispatcher"]
        return self._slots.run(self._settings, command, self._folder / "dispatcher.log")

    async def end(self) -> None:
        self._stop.set()
        await asyncio.gather(*self._tasks)


async def concluded(stores: Stores, webhook_id: str, delivery_id: str) -> DeliveryView:
    end = time.monotonic() + PATIENCE_S
    while (delivery := await stores.webhooks.delivery(webhook_id, delivery_id)).state == "pending":
        assert time.monotonic() < end, delivery
        await asyncio.sleep(0.02)
    return delivery


async def queued_job(stores: Stores) -> str:
    plan = {"steps": 3, "step_s": 0.01, "journal": "/dev/null"}
    dataset_id = await ready_dataset(stores, {"plan.json": json.dumps(plan).encode()})
    job, _ = await stores.jobs.submit(dataset_id, RefineOptions(preset="fast"), labels={"run": "ä"})
    return job.id
