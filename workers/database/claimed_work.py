"""Rows as work items: each is claimed by one of many processes, which works on several at a time."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import math
import uuid
from abc import ABC, abstractmethod
from collections.abc import AsyncIterator, Awaitable, Callable
from functools import partial
from typing import Any, ClassVar

import psycopg

from workers.database.database import Connection, Database
from workers.database.notifications import Listener
from workers.process.waiting import first_done
from workers.settings.errors import Unavailable

log = logging.getLogger(__name__)

# The rows of each tenant that have waited longest.
_CLAIM = """
    WITH waiting AS (
        SELECT work.id, work.due_at, work.leased_until > now() AS busy, row_number() OVER (PARTITION BY tenant
            ORDER BY work.leased_until > now() DESC NULLS LAST, work.due_at, work.id) AS of_tenant
        FROM {table} AS work {owners} AND (work.due_at <= now() OR work.leased_until > now()))
    UPDATE {table} SET leased_until = now() + make_interval(secs => %(lease_s)s),
        losses = losses + (token IS NOT NULL AND token <> %(token)s)::int, token = %(token)s
    WHERE id IN (SELECT id FROM {table} WHERE id IN (
            SELECT id FROM waiting WHERE busy IS NOT TRUE AND of_tenant <= %(per_tenant)s
            ORDER BY due_at, id LIMIT %(room)s)
        AND due_at <= now() AND (leased_until > now()) IS NOT TRUE FOR UPDATE SKIP LOCKED)
    RETURNING *"""


class ClaimedWork(ABC):
    """Claims rows whenever there is room, woken by notifications or after ``poll_s`` seconds."""

    at_once: ClassVar[int]

    def __init__(self, listener: Listener, poll_s: float) -> None:
        self._listener, self._poll_s = listener, poll_s
        self._under_way: set[asyncio.Task[None]] = set()

    async def run(self, stop: asyncio.Event) -> None:
        """Claim and work until ``stop``; then finish or abandon what is under way, as `_end` does."""
        with self._listener.waiting("") as woken:
            while not stop.is_set():
                woken.clear()  # before the claim, so that a notification during it is not missed
                room = self.at_once - len(self._under_way)
                try:
                    claimed = await self._claim(room) if room else []
                except (Unavailable, psycopg.Error) as error:
                    log.warning("%s can claim nothing now: %s", type(self).__name__, error)
                    claimed = []
                for row in claimed:
                    task = asyncio.create_task(self._work(row))
                    self._under_way.add(task)
                    task.add_done_callback(partial(self._done, woken))
                if len(claimed) < room or not room:
                    await first_done(woken.wait(), stop.wait(), asyncio.sleep(self._poll_s))
        await self._end()

    def _done(self, woken: asyncio.Event, task: asyncio.Task[None]) -> None:
        self._under_way.discard(task)
        woken.set()

    async def _end(self) -> None:
        await asyncio.gather(*self._under_way)

    @abstractmethod
    async def _claim(self, room: int) -> list[dict[str, Any]]:
        """Claim at most ``room`` rows; no other process gets them for a while."""

    @abstractmethod
    async def _work(self, row: dict[str, Any]) -> None:
        """Do a row's work and record the outcome. Raises nothing."""


@contextlib.asynccontextmanager
async def lease_renewed(
    renew: Callable[[], Awaitable[bool]], lease_s: float, every_s: float = math.inf
) -> AsyncIterator[None]:
    """Renew a lease of ``lease_s`` while the context lasts, or until ``renew`` returns False: it is lost.

    At least every ``every_s``, for callers whose ``renew`` also reports progress.
    """

    async def keep() -> None:
        ours = True
        while ours:
            await asyncio.sleep(min(lease_s / 4, every_s))
            with contextlib.suppress(Unavailable):  # the next time will do
                ours = await renew()

    keeping = asyncio.create_task(keep())
    try:
        yield
    finally:
        keeping.cancel()


class LeasedWork(ClaimedWork):
    """Work on rows that may take long: a row's lease is renewed until it is given back or the row is deleted.

    The table has the columns `id`, `due_at`, `round`, and `token`, `leased_until`, `losses`: who holds a row, and how
    many holders in succession were lost (`losses.py`). ``owners`` joins it, as `work`, to a `tenant`, and begins the
    WHERE clause that selects rows to work on. At shutdown, unfinished rows are left to other processes.
    """

    per_tenant: ClassVar[int]
    table: ClassVar[str]
    owners: ClassVar[str]

    def __init__(self, database: Database, listener: Listener, poll_s: float, lease_s: float) -> None:
        super().__init__(listener, poll_s)
        self._database, self._lease_s, self._token = database, lease_s, uuid.uuid4()

    @abstractmethod
    async def _do(self, row: dict[str, Any]) -> None:
        """Do the work; `Unavailable` leads to a retry."""

    async def _claim(self, room: int) -> list[dict[str, Any]]:
        values = {"lease_s": self._lease_s, "token": self._token, "per_tenant": self.per_tenant, "room": room}
        async with self._database.transaction() as connection:
            claim = _CLAIM.format(table=self.table, owners=self.owners).encode()
            return await (await connection.execute(claim, values)).fetchall()

    async def _work(self, row: dict[str, Any]) -> None:
        doing = asyncio.create_task(self._done_or_given_back(row))
        try:
            while not doing.done():
                await asyncio.wait({doing}, timeout=self._lease_s / 4)
                if not doing.done() and not await self._renewed(row):
                    return  # deleted, or leased by another process
        except asyncio.CancelledError:
            doing.cancel()
            await asyncio.wait({doing})
            await self._give_back(row)
        finally:
            doing.cancel()

    async def _done_or_given_back(self, row: dict[str, Any]) -> None:
        try:
            await self._do(row)
        except (Unavailable, psycopg.Error) as error:
            log.warning("%s of %s has to wait: %s", type(self).__name__, row["id"], error)
            await self._give_back(row)

    async def _renewed(self, row: dict[str, Any]) -> bool:
        lease = f"UPDATE {self.table} SET leased_until = now() + make_interval(secs => %s)".encode()
        lease += b" WHERE id = %s AND token = %s RETURNING id"
        try:
            return bool(await self._database.fetch(lease, self._lease_s, row["id"], self._token))
        except Unavailable:  # the next time will do
            return True

    async def _give_back(
        self, row: dict[str, Any], *, round_: int | None = None, wait_s: float = 0.0
    ) -> None:
        back = f"UPDATE {self.table} SET token = NULL, leased_until = NULL, losses = 0,".encode()
        back += b" round = coalesce(%s, round), due_at = now() + make_interval(secs => %s) WHERE id = %s AND token = %s"
        with contextlib.suppress(Unavailable, psycopg.Error):  # then the lease expires
            await self._database.fetch(back, round_, max(wait_s, self._poll_s), row["id"], self._token)

    async def _forget(self, connection: Connection, row_id: str) -> bool:
        """Delete the row; returns whether it was still ours."""
        sql = f"DELETE FROM {self.table} WHERE id = %s AND token = %s RETURNING id".encode()
        return await connection.row(sql, row_id, self._token) is not None

    async def _end(self) -> None:
        for task in self._under_way:
            task.cancel()
        await super()._end()
