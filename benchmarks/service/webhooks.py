"""How fast webhooks are sent: ``python -m benchmarks.service.webhooks [--messages 2000] [--tenants 4] [--each 2]``.

A dispatcher, a process of its own, sends messages that wait already to a receiver on this machine, which checks every
signature. Exit status 0 where each message came once.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import json
import os
import shutil
import sys
import time
from collections import Counter
from collections.abc import AsyncIterator
from dataclasses import dataclass, field
from pathlib import Path

import psutil
import standardwebhooks

from benchmarks.chaos.__main__ import new_folder
from workers.database.embedded_postgres import EmbeddedPostgres
from workers.database.migrate import migrate
from workers.engine import open_stores
from workers.settings.settings import Settings

# As long as what is told of a job.
DATA = {"id": "job_0", "state": "succeeded", "error": None, "padding": "x" * 500}
LOOK_S = 0.1


@dataclass
class Receiver:
    """Takes what is posted to /SECRET's number/ and checks it; keeps connections open as far as they are wanted."""

    secrets: list[str] = field(default_factory=list)
    heard: Counter[str] = field(default_factory=Counter)
    wrong: int = 0
    first_at: float = 0.0
    last_at: float = 0.0

    async def hear(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """One connection."""
        with contextlib.suppress(ConnectionError, asyncio.IncompleteReadError):
            while True:
                request, *lines = (await reader.readuntil(b"\r\n\r\n")).decode().splitlines()
                headers = {name.lower(): value for name, _, value in (line.partition(": ") for line in lines)}
                body = await reader.readexactly(int(headers["content-length"]))
                self._check(int(request.split("/")[1].split()[0]), headers, body)
                writer.write(b"HTTP/1.1 204 No Content\r\nContent-Length: 0\r\n\r\n")
                await writer.drain()
        writer.close()

    def _check(self, number: int, headers: dict[str, str], body: bytes) -> None:
        self.last_at = time.monotonic()
        self.first_at = self.first_at or self.last_at
        self.heard[headers["webhook-id"]] += 1
        try:
            standardwebhooks.Webhook(self.secrets[number]).verify(body, headers)
        except standardwebhooks.WebhookVerificationError:
            self.wrong += 1


@contextlib.asynccontextmanager
async def database(folder: Path) -> AsyncIterator[Settings]:
    """A private one, with settings that let webhooks go to this machine."""
    postgres = EmbeddedPostgres(folder / "postgres")
    try:
        url = postgres.start()
        migrate(url)
        yield Settings(
            data_dir=folder / "data",
            database_url=url,
            webhook_http=True,
            webhook_ports=(),
            webhook_networks=("127.0.0.0/8",),
        )
    finally:
        postgres.stop()


async def fill_outbox(settings: Settings, receiver: Receiver, port: int, asked: argparse.Namespace) -> None:
    """Webhooks of some tenants, and messages for each as jobs would leave them."""
    async with open_stores(settings) as stores:
        for tenant in (f"t{i}" for i in range(asked.tenants)):
            await stores.tenants.set(tenant)
            for _ in range(asked.each):
                url = f"http://127.0.0.1:{port}/{len(receiver.secrets)}"
                _, secret = await stores.webhooks.create(tenant, url, ["job.succeeded"])
                receiver.secrets.append(secret)
            async with stores.jobs._database.transaction() as connection:
                await connection.execute(
                    "SELECT queue_webhooks(%s, NULL, 'job.succeeded', clock_timestamp(), %s::jsonb)"
                    " FROM generate_series(1, %s)",
                    (tenant, json.dumps(DATA), asked.messages // (asked.tenants * asked.each)),
                )


async def measure(folder: Path, asked: argparse.Namespace) -> bool:
    """Print what a dispatcher did with the outbox; whether each message came once and rightly signed."""
    receiver = Receiver()
    server = await asyncio.start_server(receiver.hear, "127.0.0.1", 0)
    each = asked.messages // (asked.tenants * asked.each)
    count = each * asked.tenants * asked.each
    async with database(folder) as settings:
        await fill_outbox(settings, receiver, server.sockets[0].getsockname()[1], asked)
        said = {f"BIRESNERF_{name.upper()}": value for name, value in _plain(settings).items()}
        process = await asyncio.create_subprocess_exec(
            sys.executable, "-m", "workers.upkeep.dispatcher", env={**os.environ, **said}
        )
        looked_at, before, most = psutil.Process(process.pid), 0.0, 0
        while sum(receiver.heard.values()) < count and process.returncode is None:
            await asyncio.sleep(LOOK_S)
            most = max(most, looked_at.memory_info().rss)
            if not receiver.first_at:
                before = sum(looked_at.cpu_times()[:2])
        used = sum(looked_at.cpu_times()[:2]) - before
        process.terminate()
        await process.wait()
    server.close()
    seconds = receiver.last_at - receiver.first_at
    print(
        f"{count} messages of {asked.tenants * asked.each} webhooks, {asked.tenants} tenants: {seconds:.1f} s"
    )
    print(
        f"{count / seconds:.0f} a second, {1e3 * used / count:.1f} ms of the dispatcher's processor time each"
    )
    print(f"dispatcher's memory at the highest: {most / 2**20:.0f} MiB; wrong signatures: {receiver.wrong}")
    return receiver.wrong == 0 and set(receiver.heard.values()) == {1} and len(receiver.heard) == count


def _plain(settings: Settings) -> dict[str, str]:
    given = settings.model_dump(mode="json", exclude_unset=True)
    return {name: value if isinstance(value, str) else json.dumps(value) for name, value in given.items()}


def main() -> int:
    parser = argparse.ArgumentParser(description="The rate at which a dispatcher sends webhooks.")
    parser.add_argument("--messages", type=int, default=2000, help="in all")
    parser.add_argument("--tenants", type=int, default=4)
    parser.add_argument("--each", type=int, default=2, help="webhooks of each tenant")
    folder = new_folder()
    try:
        return int(not asyncio.run(measure(folder, parser.parse_args())))
    finally:
        shutil.rmtree(folder, ignore_errors=True)


if __name__ == "__main__":
    sys.exit(main())
