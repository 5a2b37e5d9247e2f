"""Downloads that their caller cancels: they leave no partial file, and the next one resumes."""

from __future__ import annotations

import functools
import hashlib
import os
import threading
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import anyio
import httpx
import pytest

from biresnerf.client import AsyncClient, ServiceError
from biresnerf.wire.results import ArtifactView
from tests.client.fake_service import client_of

CONTENT = os.urandom(300_000)
SENT = 100_000
FILE = ArtifactView(
    name="a", size=len(CONTENT), sha256=hashlib.sha256(CONTENT).hexdigest(), media_type="x/y", href="/a"
)


class Stalling(BaseHTTPRequestHandler):
    """Sends a third of a file and then nothing more; the rest is there for who asks for it."""

    over: threading.Event

    def do_GET(self) -> None:
        start = int(self.headers.get("Range", "bytes=0-").removeprefix("bytes=").removesuffix("-"))
        self.send_response(206 if start else 200)
        self.send_header("Content-Length", str(len(CONTENT) - start))
        self.end_headers()
        self.wfile.write(CONTENT[start:] if start else CONTENT[:SENT])
        if not start:
            self.over.wait(60)

    def log_message(self, *_: object) -> None:
        """Quiet."""


@pytest.fixture
def stalling() -> Iterator[str]:
    Stalling.over = threading.Event()
    server = ThreadingHTTPServer(("127.0.0.1", 0), Stalling)
    threading.Thread(target=server.serve_forever, args=(0.01,), daemon=True).start()
    yield f"http://127.0.0.1:{server.server_port}"
    Stalling.over.set()
    server.shutdown()
    server.server_close()


def test_a_cancelled_download_leaves_no_file_and_the_next_one_goes_on(stalling: str, tmp_path: Path) -> None:
    async def cancelled_in_the_middle() -> None:
        async with AsyncClient(stalling) as client, anyio.create_task_group() as tasks:
            arrived, there = 0, anyio.Event()

            def count(more: int) -> None:
                nonlocal arrived
                arrived += more
                if arrived == SENT:
                    there.set()

            tasks.start_soon(functools.partial(client.download, FILE, tmp_path / "a", on_bytes=count))
            await there.wait()
            tasks.cancel_scope.cancel()

    async def whole() -> list[int]:
        counted: list[int] = []
        async with AsyncClient(stalling) as client:
            await client.download(FILE, tmp_path / "a", on_bytes=counted.append)
        return counted

    anyio.run(cancelled_in_the_middle)
    (part,) = tmp_path.iterdir()
    assert part.name.startswith(".a.")
    assert part.read_bytes() == CONTENT[:SENT]
    counted = anyio.run(whole)
    assert (counted[0], sum(counted)) == (SENT, len(CONTENT))
    assert [(path.name, path.read_bytes()) for path in tmp_path.iterdir()] == [("a", CONTENT)]


def test_a_download_that_is_cancelled_before_its_first_byte_leaves_nothing(
    stalling: str, tmp_path: Path
) -> None:
    async def cancelled_while_it_looks_what_is_there() -> None:
        async with AsyncClient(stalling) as client:
            with anyio.CancelScope() as scope:
                await client.download(FILE, tmp_path / "a", on_bytes=lambda _: scope.cancel())
            assert scope.cancelled_caught

    anyio.run(cancelled_while_it_looks_what_is_there)
    assert list(tmp_path.iterdir()) == []


def test_a_file_of_the_right_length_that_arrives_with_other_content_is_not_kept(tmp_path: Path) -> None:
    other = httpx.ByteStream(CONTENT[:-1] + bytes([CONTENT[-1] ^ 1]))
    client = client_of(lambda _: httpx.Response(200, stream=other))
    with pytest.raises(ServiceError) as damaged:
        anyio.run(client.download, FILE, tmp_path / "a")
    assert damaged.value.code == "download_damaged"
    assert list(tmp_path.iterdir()) == []
