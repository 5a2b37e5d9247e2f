"""Connections: one pool per process, the queue engine on the same pool, and errors translated once."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import re
import time
from collections.abc import AsyncIterator, Iterable
from contextlib import asynccontextmanager
from datetime import UTC, datetime
from typing import Any, LiteralString

import psycopg
from procrastinate import App, PsycopgConnector
from procrastinate.connector import Notify
from procrastinate.exceptions import ConnectorException
from psycopg.rows import DictRow, dict_row
from psycopg_pool import AsyncConnectionPool, PoolClosed, PoolTimeout

from workers.settings.errors import SetupError, Unavailable

log = logging.getLogger(__name__)

Connection = psycopg.AsyncConnection[DictRow]
# What a database that is away, or just went away, raises.
AWAY = (
    *(psycopg.OperationalError, psycopg.InterfaceError, PoolTimeout, PoolClosed),
    psycopg.errors.IdleInTransactionSessionTimeout,
)
QUEUE = "refine"
TASK = "refine"
# A peer that vanished without a word (a host that lost power) is noticed within a minute.
CONNECT: dict[str, Any] = {
    "connect_timeout": 5,
    "keepalives_idle": 30,
    "keepalives_interval": 10,
    "keepalives_count": 3,
    # Keepalives rest while bytes are under way; without this a query into a dead line waits a quarter of an hour.
    "tcp_user_timeout": 60_000,
}
# When the queue offers a held job: not before `offer_held` says so.
NOT_YET = datetime(9999, 1, 1, tzinfo=UTC)
LISTEN_CHANNEL = "biresnerf_jobs"
RECONNECT_S = 1.0
QUIET_S = 60.0  # between two warnings of the same outage


class PatientConnector(PsycopgConnector):
    """The queue's connector, except that its listener outlives a restart of the database.

    And that a query is given up where no answer comes: the line may be dead with both its ends alive.
    """

    def __init__(self, answer_s: float, **options: Any) -> None:
        super().__init__(**options)
        self._answer_s = answer_s

    async def execute_query_async(self, query: LiteralString, **arguments: Any) -> None:
        """As the engine's."""
        async with self._in_time():
            await super().execute_query_async(query, **arguments)

    async def execute_query_one_async(self, query: LiteralString, **arguments: Any) -> dict[str, Any]:
        """As the engine's."""
        async with self._in_time():
            return await super().execute_query_one_async(query, **arguments)

    async def execute_query_all_async(self, query: LiteralString, **arguments: Any) -> list[dict[str, Any]]:
        """As the engine's."""
        async with self._in_time():
            return await super().execute_query_all_async(query, **arguments)

    @asynccontextmanager
    async def _in_time(self) -> AsyncIterator[None]:
        try:
            async with asyncio.timeout(self._answer_s):
                yield
        except TimeoutError as error:
            raise ConnectorException(f"no answer within {self._answer_s:g} s") from error

    async def listen_notify(self, on_notification: Notify, channels: Iterable[str]) -> None:
        """Listen for ever; while the database is away, try again each second (polling fills the gap)."""
        wanted, said_at = list(channels), 0.0
        while True:
            try:
                await super().listen_notify(on_notification, wanted)
            except (ConnectorException, *AWAY) as error:
                if time.monotonic() - said_at > QUIET_S:
                    said_at = time.monotonic()
                    log.warning("queue listener lost the database (%s)", first_line(error.__cause__ or error))
                await asyncio.sleep(1)


class Database:
    """One process's pool and queue app. Use `open_database`."""

    def __init__(self, url: str, pool: AsyncConnectionPool[Connection], app: App, answer_s: float) -> None:
        self.url, self.pool, self.app, self._answer_s = url, pool, app, answer_s

    @asynccontextmanager
    async def transaction(self) -> AsyncIterator[Connection]:
        """A connection inside one transaction; raises `Unavailable` where the database is away.

        Also where it takes longer than it may: a connection can fall silent without an end.
        """
        try:
            async with asyncio.timeout(self._answer_s), self.pool.connection() as connection:
                yield connection
        except TimeoutError as error:
            await self.pool.drain()  # where one line is dead the others are, and each would cost as long
            raise Unavailable(
                "database_unavailable", f"The database did not answer within {self._answer_s:g} s."
            ) from error
        except AWAY as error:
            raise Unavailable(
                "database_unavailable", f"The database does not answer: {first_line(error)}"
            ) from error

    async def fetch(self, sql: LiteralString, *parameters: Any) -> list[DictRow]:
        """Rows of one statement in a transaction of its own."""
        async with self.transaction() as connection:
            cursor = await connection.execute(sql, parameters)
            return await cursor.fetchall() if cursor.description else []

    async def enqueue(self, connection: Connection, job_id: str) -> int:
        """Put a job into the queue at its turn, in the caller's transaction; returns the queue row's id."""
        sql = "SELECT queue_order, held FROM jobs WHERE id = %s"
        row = await (await connection.execute(sql, (job_id,))).fetchone()
        assert row is not None, "the caller has written it"
        task = self.app.configure_task(
            TASK,
            queue=QUEUE,
            connection=connection,
            priority=-row["queue_order"],
            schedule_at=NOT_YET if row["held"] else None,
        )
        try:
            return await task.defer_async(job_id=job_id)
        except ConnectorException as error:
            if isinstance(error.__cause__, AWAY):
                raise error.__cause__ from None
            raise


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
    """Pool and queue app, closed at the end.

    Args:
        connections: most connections of the pool.
        patience_s: how long a caller waits for a free and living connection.
        opening_s: how long to wait for the database at the start.
        silence_s: a transaction in which nothing is asked for so long is rolled back by the database.
        answer_s: how long a transaction may take; a database that does not answer for so long is away.

    Raises `SetupError` if the database does not answer in time or is not migrated.
    """

    async def end_if_silent(connection: Connection) -> None:
        # A process frozen within a transaction, or a host gone without a word, would hold its locks for ever.
        await connection.execute(
            "SELECT set_config('idle_in_transaction_session_timeout', %s, false)",
            (str(round(1000 * silence_s)),),
        )
        await connection.commit()

    pool: AsyncConnectionPool[Connection] = AsyncConnectionPool(
        url,
        min_size=1,
        max_size=connections,
        timeout=patience_s,
        # The pool's own retries wait twice as long each time: minutes, after an outage of minutes.
        reconnect_timeout=RECONNECT_S,
        reconnect_failed=_keep_trying,
        kwargs={"row_factory": dict_row, **CONNECT},
        connection_class=psycopg.AsyncConnection[DictRow],
        configure=end_if_silent,
        check=AsyncConnectionPool.check_connection,  # connections killed with the server are replaced unseen
        open=False,
    )
    logging.getLogger("psycopg.pool").setLevel(logging.ERROR)  # it warns at every reconnect attempt
    try:
        await pool.open(wait=True, timeout=opening_s)
    except PoolTimeout:
        await pool.close()
        raise SetupError(
            "database_unreachable", f"The database at {without_password(url)} does not answer."
        ) from None
    try:
        app = App(connector=PatientConnector(answer_s, conninfo=url, kwargs=CONNECT))
        async with app.open_async(pool):
            database = Database(url, pool, app, answer_s)
            await _require_schema(database)
            yield database
    finally:
        await pool.close()


async def _keep_trying(pool: AsyncConnectionPool[Connection]) -> None:
    """Asking for a connection makes the pool connect again; if that fails too, it calls this again."""
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
    """The address fit for a log."""
    return re.sub(r"(://[^:/@]*):[^@]*@", r"\1:***@", url)
