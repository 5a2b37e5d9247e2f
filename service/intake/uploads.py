"""Streams request bodies to disk, within limits, without holding them in memory."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncGenerator, AsyncIterator
from pathlib import Path
from typing import Any

from fastapi import Request

from service.http.problems import ProblemError
from workers.process.disk_space import DiskBudget

# A client that sends nothing for this long only occupies a connection and a folder.
IDLE_S = 60.0
_CHECK_EVERY_BYTES = 16 * 2**20  # between two checks of the free disk space


def raw_request(*media_types: str) -> dict[str, Any]:
    """The `openapi_extra` of a route whose body is the bytes of a file."""
    content = {"schema": {"type": "string", "format": "binary"}}
    return {"requestBody": {"required": True, "content": dict.fromkeys(media_types, content)}}


def limited_body(
    request: Request, limit_bytes: int, budget: DiskBudget | None = None
) -> AsyncGenerator[bytes, None]:
    """The request's body through `capped`; refused at once if its Content-Length exceeds the limits."""
    announced = request.headers.get("content-length", "")
    if announced.isdigit():
        if int(announced) > limit_bytes:
            raise _too_large(limit_bytes)
        if budget is not None:
            budget.require(int(announced))
    return capped(request.stream(), limit_bytes, budget=budget)


async def capped(
    stream: AsyncIterator[bytes], limit_bytes: int, idle_s: float = IDLE_S, budget: DiskBudget | None = None
) -> AsyncGenerator[bytes, None]:
    """The stream, with limits on its size and on the time between two chunks.

    Raises:
        ProblemError: ``body_too_large`` at the first byte beyond the limit; ``body_timeout`` if nothing
            arrives for ``idle_s``.
        LimitReached: ``storage_full`` if the disk has no room, at the start or later.
    """
    total, checked_at = 0, -_CHECK_EVERY_BYTES
    while True:
        try:
            async with asyncio.timeout(idle_s):
                chunk = await anext(stream)
        except StopAsyncIteration:
            return
        except TimeoutError:
            raise ProblemError("body_timeout", f"No byte of the body came for {idle_s:g} s.") from None
        total += len(chunk)
        if total > limit_bytes:
            raise _too_large(limit_bytes)
        if budget is not None and total - checked_at >= _CHECK_EVERY_BYTES:
            await asyncio.to_thread(budget.require)
            checked_at = total
        yield chunk


def _too_large(limit_bytes: int) -> ProblemError:
    return ProblemError(
        "body_too_large",
        f"The body is larger than {limit_bytes} bytes.",
        hint="Send fewer or smaller images, or single files; GET /v1/info tells the limits.",
    )


async def write_stream(stream: AsyncIterator[bytes], target: Path) -> None:
    """Writes the stream to a new file."""
    with target.open("xb") as out:
        async for chunk in stream:
            await asyncio.to_thread(out.write, chunk)
