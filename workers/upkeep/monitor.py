"""Whether what the service needs is there, and the figures of the whole installation."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable
from typing import Literal

from biresnerf.wire.operator import OperatorView
from workers.database.database import Database
from workers.database.migrate import step_names
from workers.database.statistics import Statistics, living_slots, read_statistics
from workers.settings.errors import Unavailable
from workers.store.files import FileStore
from workers.upkeep.overview import read_overview

Need = Literal["database", "storage", "queue"]
# A probe that waits longer than its caller tells nothing.
CHECK_S = 2.0


class Monitor:
    """Looks without changing anything. Get one from `workers.engine.open_stores`."""

    def __init__(self, database: Database, files: FileStore, stall_s: float) -> None:
        self._database, self._files, self._stall_s = database, files, stall_s

    @property
    def broken(self) -> asyncio.Event:
        """Set once this process lost connections to the database for good."""
        return self._database.broken

    async def statistics(self) -> Statistics:
        """The figures; raises `Unavailable`."""
        return await read_statistics(self._database, self._stall_s)

    async def overview(self) -> OperatorView:
        """What its operator wants to see of the installation; raises `Unavailable`."""
        return await read_overview(self._database, self._stall_s)

    async def living_workers(self) -> int:
        """Worker slots that sent a heartbeat within the stall time; raises `Unavailable`."""
        return await living_slots(self._database, self._stall_s)

    async def lacking(self) -> dict[Need, str]:
        """What is not as it has to be, and why; empty where jobs can be taken. Answers within seconds."""
        needs: dict[Need, Awaitable[str]] = {
            "database": self._database_problem(),
            "storage": self._storage_problem(),
            "queue": self._queue_problem(),
        }
        found = await asyncio.gather(*(_in_time(need) for need in needs.values()))
        return {need: why for need, why in zip(needs, found, strict=True) if why}

    async def _database_problem(self) -> str:
        await self._database.fetch("SELECT 1")
        return ""

    async def _storage_problem(self) -> str:
        return "" if await self._files.healthy() else "Files cannot be written."

    async def _queue_problem(self) -> str:
        await self._database.fetch("SELECT 1 FROM queue_entries LIMIT 1")
        done = {row["name"] for row in await self._database.fetch("SELECT name FROM schema_steps")}
        missing = [name for name in step_names() if name not in done]
        return f"The database lacks {', '.join(missing)}: run `biresnerf migrate`." if missing else ""


async def _in_time(check: Awaitable[str]) -> str:
    asked = asyncio.ensure_future(check)
    # A query is cancelled by asking the server, which takes long where that is frozen: nobody waits for it here.
    asked.add_done_callback(lambda done: done.cancelled() or done.exception())
    try:
        await asyncio.wait({asked}, timeout=CHECK_S)
        return await asked if asked.done() else f"No answer within {CHECK_S:g} s."
    except Unavailable as error:
        return error.detail
    finally:
        asked.cancel()
