"""A real HTTP server of files that misbehaves on purpose."""

from __future__ import annotations

import asyncio
import contextlib
import re
from collections.abc import AsyncIterator
from dataclasses import dataclass, field


@dataclass
class Page:
    """What is at a path.

    Attributes:
        heads: status lines (with headers) to answer before the file is given; the last of them for ever if there is no
            content. None is silence.
        cuts: after how many bytes of the body the connection ends, in turn.
        pause_s: between two blocks of 64 KiB.
    """

    content: bytes | None = None
    heads: list[bytes | None] = field(default_factory=list)
    etag: str | None = '"one"'
    ranges: bool = True
    chunked: bool = False
    cuts: list[int] = field(default_factory=list)
    pause_s: float = 0.0


class FileServer:
    """Pages by path; ``asked`` has the path and the headers of each request."""

    def __init__(self) -> None:
        self.pages: dict[str, Page] = {}
        self.asked: list[tuple[str, dict[str, str]]] = []
        self.url, self._held = "", asyncio.Event()

    def file(self, path: str, content: bytes, **how: object) -> str:
        self.pages[path] = Page(content, **how)
        return f"{self.url}{path}?X-Amz-Signature=SECRETSIGNATURE"

    def answers(self, path: str, *heads: bytes | None) -> str:
        self.pages[path] = Page(heads=list(heads))
        return f"{self.url}{path}?X-Amz-Signature=SECRETSIGNATURE"

    def ranges_of(self, path: str) -> list[str]:
        return [headers.get("range", "") for asked, headers in self.asked if asked == path]

    async def hear(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        try:
            lines = (await reader.readuntil(b"\r\n\r\n")).decode().splitlines()
            path = lines[0].split()[1].partition("?")[0]
            headers = {name.lower(): value for name, _, value in (line.partition(": ") for line in lines[1:])}
            self.asked.append((path, headers))
            page = self.pages[path]
            if page.heads:
                last = page.content is None and len(page.heads) == 1
                head = page.heads[0] if last else page.heads.pop(0)
                if head is None:
                    await self._held.wait()
                else:
                    writer.write(b"HTTP/1.1 " + head + b"\r\nContent-Length: 0\r\n\r\n")
                    await writer.drain()
                return
            await self._send(page, headers, writer)
        except (ConnectionError, asyncio.IncompleteReadError):
            pass
        finally:
            writer.close()

    async def _send(self, page: Page, headers: dict[str, str], writer: asyncio.StreamWriter) -> None:
        whole = page.content or b""
        wanted = re.fullmatch(r"bytes=(\d+)-", headers.get("range", ""))
        part = wanted and page.ranges and headers.get("if-range", page.etag) == page.etag
        start = int(wanted[1]) if wanted and part else 0
        body = whole[start:]
        lines = ["HTTP/1.1 206 Partial Content" if part else "HTTP/1.1 200 OK"]
        lines += [f"ETag: {page.etag}"] if page.etag else []
        lines += [f"Content-Range: bytes {start}-{len(whole) - 1}/{len(whole)}"] if part else []
        lines += ["Transfer-Encoding: chunked"] if page.chunked else [f"Content-Length: {len(body)}"]
        writer.write("\r\n".join([*lines, "", ""]).encode())
        stop = page.cuts.pop(0) if page.cuts else len(body)
        for at in range(0, min(stop, len(body)), 2**16):
            block = body[at : min(at + 2**16, stop)]
            writer.write(b"%x\r\n%s\r\n" % (len(block), block) if page.chunked else block)
            await writer.drain()
            await asyncio.sleep(page.pause_s)
        if page.chunked and stop >= len(body):
            writer.write(b"0\r\n\r\n")
        await writer.drain()

    @contextlib.asynccontextmanager
    async def open(self) -> AsyncIterator[FileServer]:
        server = await asyncio.start_server(self.hear, "127.0.0.1", 0)
        self.url = f"http://127.0.0.1:{server.sockets[0].getsockname()[1]}"
        try:
            yield self
        finally:
            self._held.set()
            server.close()
