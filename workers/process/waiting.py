"""Waiting: for the first of several things, or for a database or file store that is away."""

from __future__ import annotations

import asyncio
import logging
import time
from collections.abc import Awaitable, Callable
from typing import TypeVar

from workers.settings.errors import Unavailable

log = logging.getLogger(__name__)

RETRY_S = 0.5
WARN_AGAIN_S = 60.0
T = TypeVar("T")


async def first_done(*waits: Awaitable[object]) -> None:
    """Wait for the first to finish; cancels the other coroutines, but leaves tasks running."""
    tasks = [asyncio.ensure_future(wait) for wait in waits]
    try:
        await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
    finally:
        for task, wait in zip(tasks, waits, strict=True):
            if task is not wait:
                task.cancel()


async def retry_while_unavailable(work: Callable[[], Awaitable[T]]) -> T:
    """The result of ``work``, retried while it raises `Unavailable`. Warns once a minute."""
    warned_at = -WARN_AGAIN_S
    while True:
        try:
            return await work()
        except Unavailable as error:
            if time.monotonic() - warned_at >= WARN_AGAIN_S:
                warned_at = time.monotonic()
                log.warning("%s; trying again until it answers", error)
            await asyncio.sleep(RETRY_S)
