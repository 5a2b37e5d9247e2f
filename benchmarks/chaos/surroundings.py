"""External resources of real jobs, with their faults: a small disk, an object store, a clock."""

from __future__ import annotations

import asyncio
import contextlib
import os
import shutil
import signal
import subprocess
import sys
import uuid
from collections.abc import AsyncIterator
from dataclasses import dataclass
from pathlib import Path

import boto3
from botocore.config import Config

from workers.process.die_with_parent import dying_with_parent

DISK_BYTES = 192 * 2**20
RESERVE_BYTES = 8 * 2**20
CLOCK_SOURCE = Path(__file__).with_name("wrong_clock.c")
KEY = "storm"


def lacking() -> list[str]:
    """What this machine lacks for a storm with real jobs."""
    found = [] if shutil.which("gcc") else ["gcc, to build the wrong clock"]
    return found if os.geteuid() == 0 else [*found, "root, to mount a small disk"]


class SmallDisk:
    """A separate file system, small enough to be filled."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        folder.mkdir()
        options = f"size={DISK_BYTES},mode=0711"
        subprocess.run(["mount", "-t", "tmpfs", "-o", options, "tmpfs", folder], check=True)

    def unmount(self) -> None:
        """Unmount it, with whatever is left there."""
        subprocess.run(["umount", "--lazy", self.folder], check=True)

    async def fill(self, seconds: float) -> None:
        """Fill it to the last byte for a while; keeps taking the space that others free."""
        ballast = self.folder / "ballast"
        end = asyncio.get_running_loop().time() + seconds
        with ballast.open("wb", buffering=0) as file:
            while asyncio.get_running_loop().time() < end:
                with contextlib.suppress(OSError):  # full
                    for _ in range(max(1, shutil.disk_usage(self.folder).free // 2**20)):
                        file.write(bytes(2**20))
                await asyncio.sleep(0.1)
        ballast.unlink()


class ObjectStore:
    """An S3 server in a separate process, reached through a relay that can be cut."""

    def __init__(self, port: int, relay_port: int, log: Path) -> None:
        self._port, self._relay_port, self._log = port, relay_port, log
        self._bucket = f"storm-{uuid.uuid4().hex[:8]}"
        self._away = False
        self._open: set[asyncio.StreamWriter] = set()

    @contextlib.asynccontextmanager
    async def serving(self) -> AsyncIterator[None]:
        """Runs the server with an empty bucket."""
        command = [sys.executable, "-m", "moto.server", "-H", "127.0.0.1", "-p", str(self._port)]
        with self._log.open("ab") as log:
            self._process = subprocess.Popen(
                dying_with_parent(command, signal_number=signal.SIGKILL), stdout=log, stderr=log
            )
        while True:
            with contextlib.suppress(OSError):
                _, probe = await asyncio.open_connection("127.0.0.1", self._port)
                probe.close()
                break
            await asyncio.sleep(0.1)
        await asyncio.to_thread(self._client().create_bucket, Bucket=self._bucket)
        relay = await asyncio.start_server(self._carry, "127.0.0.1", self._relay_port)
        try:
            yield
        finally:
            relay.close()
            self._process.kill()
            self._process.wait()

    def settings(self) -> dict[str, object]:
        """The settings of processes that use it."""
        return {
            "storage_url": f"s3://{self._bucket}/all",
            "storage_endpoint": f"http://127.0.0.1:{self._relay_port}",
            "storage_access_key_id": KEY,
            "storage_secret_access_key": KEY,
        }

    def keys(self) -> set[str]:
        """The keys of all files."""
        pages = self._client().get_paginator("list_objects_v2").paginate(Bucket=self._bucket, Prefix="all/")
        return {item["Key"].removeprefix("all/") for page in pages for item in page.get("Contents", ())}

    async def refuse(self, seconds: float) -> None:
        """Break connections, and serve no new one."""
        self._away = True
        for writer in list(self._open):
            writer.transport.abort()
        await asyncio.sleep(seconds)
        self._away = False

    async def fall_silent(self, seconds: float) -> None:
        """Keep connections open, but do not answer."""
        self._process.send_signal(signal.SIGSTOP)
        await asyncio.sleep(seconds)
        self._process.send_signal(signal.SIGCONT)

    def _client(self):
        return boto3.client(
            "s3",
            endpoint_url=f"http://127.0.0.1:{self._port}",
            aws_access_key_id=KEY,
            aws_secret_access_key=KEY,
            region_name="us-east-1",
            config=Config(retries={"max_attempts": 1}),
        )

    async def _carry(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        if self._away:
            writer.transport.abort()
            return
        with contextlib.suppress(OSError):
            far_reader, far_writer = await asyncio.open_connection("127.0.0.1", self._port)
            both = {writer, far_writer}
            self._open |= both
            try:
                await asyncio.gather(_pump(reader, far_writer), _pump(far_reader, writer))
            finally:
                self._open -= both
                for end in both:
                    end.transport.abort()


async def _pump(source: asyncio.StreamReader, sink: asyncio.StreamWriter) -> None:
    while data := await source.read(2**16):
        sink.write(data)
        await sink.drain()
    if sink.can_write_eof():
        sink.write_eof()


class WrongClock:
    """The wall clock of one worker and its jobs, set by a file; changes take effect within a second."""

    def __init__(self, folder: Path) -> None:
        self._file, self._library = folder / "clock", folder / "wrong_clock.so"
        command = ["gcc", "-O2", "-shared", "-fPIC", "-o", str(self._library), str(CLOCK_SOURCE)]
        subprocess.run(command, check=True)
        self.jump(0)

    def jump(self, seconds: int) -> None:
        """Set the offset from the true time."""
        fresh = self._file.with_suffix(".new")
        fresh.write_text(f"{seconds}\n")
        fresh.rename(self._file)

    def variables(self) -> dict[str, str]:
        """The environment variables of a process with this clock."""
        return {"LD_PRELOAD": str(self._library), "WRONG_CLOCK_FILE": str(self._file)}


@dataclass(frozen=True)
class Surroundings:
    """Everything that a storm with real jobs can break."""

    disk: SmallDisk
    store: ObjectStore
    clock: WrongClock
