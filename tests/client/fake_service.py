"""An `AsyncClient` connected to a fake service, a function in this process."""

from __future__ import annotations

from collections.abc import AsyncIterator, Callable, Iterable

import httpx

from biresnerf.client import AsyncClient

URL = "http://service.test"


def client_of(
    answer: Callable[[httpx.Request], httpx.Response], *, patience_s: float = 60.0, answered: bool = True
) -> AsyncClient:
    """A client that gets its answers from ``answer``; ``answered``: as if there had been one before."""
    client = AsyncClient(URL, patience_s=patience_s)
    client._http = httpx.AsyncClient(base_url=URL, transport=httpx.MockTransport(answer))
    client._policy.answered = answered
    return client


def event_stream(*parts: bytes | Exception) -> httpx.Response:
    """A stream that sends the parts one by one; an exception breaks it."""

    async def content(parts: Iterable[bytes | Exception] = parts) -> AsyncIterator[bytes]:
        for part in parts:
            if isinstance(part, Exception):
                raise part
            yield part

    return httpx.Response(200, headers={"Content-Type": "text/event-stream"}, content=content())
