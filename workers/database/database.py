"""Connections: one pool per process, and errors translated once."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import re
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager
from copy import copy
from typing import Any, Concatenate, LiteralString, ParamSpec, Self, TypeVar

import psycopg
from psycopg.rows import DictRow, dict_row
from psycopg.sql import SQL, Composed
from psycopg_pool import AsyncConnectionPool, PoolClosed, PoolTimeout

from workers.database.whole_pool import WholePool
from workers.settings.errors import NotFound, SetupError, Unavailable

log = logging.getLogger(__name__)

# Errors of a database that is unavailable, or becomes so.
AWAY = (
    *(psycopg.OperationalError, psycopg.InterfaceError, PoolTimeout, PoolClosed),
    psycopg.errors.IdleInTransactionSessionTimeout,
    psycopg.errors.FeatureNotSupported,  # by a statement prepared before a migration; the next one is prepared anew
)
# A peer that vanished silently (a host that lost power) is noticed within a minute.
CONNECT: dict[str, Any] = {
    "connect_timeout": 5,
    "keepalives_idle": 30,
    "keepalives_interval": 10,
    "keepalives_count": 3,
    # Keepalives pause while data is unacknowledged; without this a query on a dead connection hangs for 15 minutes.
    "tcp_user_timeout": 60_000,
}
RECONNECT_S = 1.0
# A pool that replaces connections lacks them for seconds.
LOOK_S, LOOKS = 1.0, 90


P = ParamSpec("P")
T = TypeVar("T")
Statement = LiteralString | bytes | SQL | Composed


class Connection(psycopg.AsyncConnection[DictRow]):
    """A connection that returns rows as dicts."""

    async def row(self, statement: Statement, *parameters: Any) -> DictRow | None:
        """The first row of a statement, if there is one."""
        return await (await self.execute(statement, parameters)).fetchone()

    async def only_row(self, statement: Statement, *parameters: Any) -> DictRow:
        """The row of a statement that always gives one (an aggregate, RETURNING, a locked row)."""
        row = await self.row(statement, *parameters)
        assert row is not None, statement
        return row

    async def required_row(self, missing: str, statement: Statement, *parameters: Any) -> DictRow:
        """The first row of a statement; raises `NotFound` with the message ``missing`` where there is none."""
        row = await self.row(statement, *parameters)
        if row is None:
            raise NotFound(missing)
        return row

    async def value(self, statement: Statement, *parameters: Any) -> Any:
        """The first value of the first row; None if there is no row."""
        row = await self.row(statement, *parameters)
        return None if row is None else next(iter(row.values()))

    async def rows(self, statement: Statement, *parameters: Any) -> list[DictRow]:
        """All rows of a statement."""
        return await (await self.execute(statement, parameters)).fetchall()


class Database:
    """One process's pool of connections. Use `open_database`.

    Attributes:
        broken: set once the pool has lost connections for good though the database answers; needs a restart.
    """

    def __init__(self, url: str, pool: AsyncConnectionPool[Connection], answer_s: float) -> None:
        self.url, self.pool, self._answer_s = url, pool, answer_s
        self.broken = asyncio.Event()

    @asynccontextmanager
    async def transaction(self) -> AsyncIterator[Connection]:
        """A connection inside one transaction; raises `Unavailable` if the database is away.

        Also raises it after a timeout: a connection can hang forever.
        """
        try:
            # Returning the connection is not timed: a committed transaction must not be "too late".
            async with contextlib.AsyncExitStack() as at_end, asyncio.timeout(self._answer_s):
                connection = await self.pool.getconn()
                at_end.push_async_callback(self.pool.putconn, connection)
                async with connection:
                    yield connection
        except TimeoutError as error:
            await self.pool.drain()  # the others are dead as well, and each would take as long
            raise Unavailable(
                "database_unavailable", f"The database did not answer within {self._answer_s:g} s."
            ) from error
        except AWAY as error:
            log.warning("the database does not answer: %s", first_line(error))
            raise Unavailable("database_unavailable", "The database does not answer.") from error

    async def run(
        self, work: Callable[Concatenate[Connection, P], Awaitable[T]], *given: P.args, **named: P.kwargs
    ) -> T:
        """The result of ``work`` in its own transaction; raises `Unavailable`."""
        async with self.transaction() as connection:
            return await work(connection, *given, **named)

    async def fetch(self, statement: Statement, *parameters: Any) -> list[DictRow]:
        """The rows of one statement in its own transaction."""
        async with self.transaction() as connection:
            cursor = await connection.execute(statement, parameters)
            return await cursor.fetchall() if cursor.description else []


class OwnedStore:
    """Base of stores whose rows belong to tenants: initially it sees those of all, as the operator does."""

    def __init__(self, database: Database) -> None:
        self._database = database
        self._tenant: str | None = None

    def for_tenant(self, tenant: str | None) -> Self:
        """The store limited to this tenant: rows of others seem not to exist. None: all tenants."""
        bound = copy(self)
        bound._tenant = tenant
        return bound


@asynccontextmanager
async def open_database(
    url: str,
    *,
    connections: int = 8,
    patience_s: float = 10.0,
    opening_s: float = 30.0,
    silence_s: float = 60.0,
    answer_s: float = 20.0,
) -> AsyncIterator[Database]:
    """A pool of connections, closed at the end.

    Args:
        connections: maximum size of the pool.
        patience_s: how long a caller waits for a working connection.
        opening_s: how long to wait for the database at the start.
        silence_s: the database rolls back a transaction that is idle for so long.
        answer_s: how long a transaction may take before the database counts as away.

    Raises `SetupError` if the database does not answer in time or is not migrated.
    """

    async def end_if_silent(connection: Connection) -> None:
        # A process frozen within a transaction, or a host that vanished, would hold its locks forever.
        await connection.execute(
            "SELECT set_config('idle_in_transaction_session_timeout', %s, false)",
            (str(round(1000 * silence_s)),),
        )
        await connection.commit()

    pool: WholePool[Connection] = WholePool(
        url,
        min_size=1,
        max_size=connections,
        timeout=patience_s,
        # The pool's own backoff doubles each time: minutes, after an outage of minutes.
        reconnect_timeout=RECONNECT_S,
        reconnect_failed=_keep_trying,
        kwargs={"row_factory": dict_row, **CONNECT},
        connection_class=Connection,
        configure=end_if_silent,
        open=False,
    )
    try:
        await pool.open(wait=True, timeout=opening_s)
    except PoolTimeout:
        await pool.close()
        raise SetupError(
            "database_unreachable", f"The database at {without_password(url)} does not answer."
        ) from None
    try:
        database = Database(url, pool, answer_s)
        await _require_schema(database)
        watching = asyncio.create_task(_watch(database, pool))
        try:
            yield database
        finally:
            watching.cancel()
    finally:
        await pool.close()


async def _watch(database: Database, pool: WholePool[Connection]) -> None:
    """Sets ``database.broken`` if the pool lacks connections persistently though a new one works."""
    in_vain = 0  # counts looks, not seconds: a frozen process does not look
    while True:
        await asyncio.sleep(LOOK_S)
        in_vain = in_vain + 1 if pool.lost() > 0 else 0
        if in_vain >= LOOKS and await _answers(database.url):
            log.critical(
                "the pool lost %d of its connections to the database, which answers; only a restart helps",
                pool.lost(),
            )
            database.broken.set()
            return


async def _answers(url: str) -> bool:
    """Whether a connection outside the pool works."""
    try:
        async with await psycopg.AsyncConnection.connect(url, **CONNECT) as fresh:
            await fresh.execute("SELECT 1")
    except AWAY:
        return False
    return True


async def _keep_trying(pool: AsyncConnectionPool[Connection]) -> None:
    """Request a connection, so that the pool reconnects; if that fails too, the pool calls this again."""
    with contextlib.suppress(PoolTimeout, PoolClosed):
        async with pool.connection(timeout=RECONNECT_S):
            return


async def _require_schema(database: Database) -> None:
    rows = await database.fetch(
        "SELECT to_regclass('jobs') IS NOT NULL AS ours, to_regclass('schema_steps') AS steps"
    )
    if not rows[0]["ours"]:
        raise SetupError("database_not_migrated", "The database has no tables yet. Run `biresnerf migrate`.")


def first_line(error: BaseException) -> str:
    """The first line of an error's text, or its type's name."""
    return (str(error).strip() or type(error).__name__).splitlines()[0]


def without_password(url: str) -> str:
    """The address without its password, for logs."""
    return re.sub(r"(://[^:/@]*):[^@]*@", r"\1:***@", url)
