"""Work that takes its process down is given up: one rule for all that one of many processes takes.

A take counts while its process could be lost to the work itself, as while it reads what a stranger sent. Whoever ends
that part alive, however it went, ends the count, and so does whoever gets further than all takes before. So only takes
that were lost in a row, without progress, give work up: kills and restarts of a healthy service seldom hit it so often.
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
    """`LOSSES_MAX` takes in a row were lost."""


@contextlib.asynccontextmanager
async def counted(database: Database, column: str, row_id: str | None) -> AsyncIterator[None]:
    """Around the part of a take that may cost its process; ``column`` (``table.name``) counts the row's losses.

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
    """A statement at the end of a take: perhaps of the process, which waits for no database that is away."""
    with contextlib.suppress(Unavailable, TimeoutError):
        async with asyncio.timeout(GIVE_BACK_S):
            await database.fetch(statement, *values)
