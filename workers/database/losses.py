"""Gives up work that keeps killing its process: one rule for all work that processes claim.

A claim (take) counts while the work itself could kill the process, as while it parses strangers' files. The count is
reset when a process survives that part, with whatever outcome, or gets further than all before it. So work is given up
only after consecutive losses without progress, which kills and restarts of a healthy service seldom cause.
"""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncIterator

from workers.database.database import Database
from workers.settings.errors import Unavailable

LOSSES_MAX = 4
GIVE_BACK_S = 2.0


class LostTooOften(Exception):
    """`LOSSES_MAX` processes in succession were lost to this work."""


@contextlib.asynccontextmanager
async def counted(database: Database, column: str, row_id: str | None) -> AsyncIterator[None]:
    """Wraps work that may kill its process; ``column`` (``table.name``) counts the row's losses.

    Raises:
        LostTooOften: before the work begins.
    """
    table, _, losses = column.partition(".")
    more = f"UPDATE {table} SET {losses} = {losses} + 1 WHERE id = %s RETURNING {losses} AS count"
    rows = await database.fetch(more, row_id)
    if rows and rows[0]["count"] > LOSSES_MAX:
        raise LostTooOften
    try:
        yield
    finally:
        await at_an_end(database, f"UPDATE {table} SET {losses} = 0 WHERE id = %s", row_id)


async def at_an_end(database: Database, statement: str, *values: object) -> None:
    """Run a statement at the end of a claim; gives up soon if the database is away: the process may be ending."""
    with contextlib.suppress(Unavailable, TimeoutError):
        async with asyncio.timeout(GIVE_BACK_S):
            await database.fetch(statement, *values)
