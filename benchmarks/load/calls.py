"""Calls to one API process, timed by endpoint; and that process's memory and CPU time."""

from __future__ import annotations

import asyncio
import statistics
import time
from collections import defaultdict
from collections.abc import Awaitable, Callable, Iterable
from typing import Any

import httpx
import psutil

ANSWER_S = 120.0


class Calls:
    """An HTTP client that remembers how long each endpoint took."""

    def __init__(self, url: str) -> None:
        self.http = httpx.AsyncClient(
            base_url=url,
            timeout=ANSWER_S,
            limits=httpx.Limits(max_connections=None, max_keepalive_connections=64),
        )
        self.took: dict[str, list[float]] = defaultdict(list)
        self.refused: list[str] = []

    async def __call__(self, name: str, method: str, path: str, **request: Any) -> httpx.Response:
        """One timed call; records answers of 400 or more."""
        began = time.perf_counter()
        answer = await self.http.request(method, path, **request)
        self.took[name].append(time.perf_counter() - began)
        if answer.status_code >= 400:
            self.refused.append(f"{name}: {answer.status_code} {answer.text[:200]}")
        return answer

    def table(self) -> dict[str, dict[str, float]]:
        """Milliseconds by endpoint."""
        return {name: spread(seconds) for name, seconds in sorted(self.took.items())}


def spread(seconds: list[float]) -> dict[str, float]:
    """The count, and p50, p99 and maximum in milliseconds."""
    ordered = sorted(seconds)
    p99 = ordered[min(len(ordered) - 1, round(0.99 * len(ordered)))]
    return {
        "n": len(ordered),
        "p50_ms": round(1000 * statistics.median(ordered), 2),
        "p99_ms": round(1000 * p99, 2),
        "max_ms": round(1000 * ordered[-1], 2),
    }


async def at_once(width: int, work: Iterable[Callable[[], Awaitable[Any]]]) -> float:
    """Do all the work, ``width`` at a time; returns the seconds it took."""
    began, queue = time.perf_counter(), iter(list(work))

    async def one() -> None:
        for task in queue:
            await task()

    await asyncio.gather(*(one() for _ in range(width)))
    return time.perf_counter() - began


class Process:
    """Memory and CPU time of a process."""

    def __init__(self, pid: int) -> None:
        self._process = psutil.Process(pid)

    def mib(self) -> float:
        """Resident memory now."""
        return round(self._process.memory_info().rss / 2**20, 1)

    def cpu_s(self) -> float:
        """User and system time so far."""
        times = self._process.cpu_times()
        return float(times.user + times.system)
