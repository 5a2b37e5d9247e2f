"""No cancellation costs the pool a connection, and a process whose pool lost some says so and ends."""

from __future__ import annotations

import asyncio
import contextlib
import subprocess
import sys
import time
from collections.abc import AsyncIterator

import pytest
from psycopg_pool import AsyncConnectionPool

from tests.service.in_process import serving
from tests.workers.conftest import environment
from workers.database import database as database_module
from workers.database.database import Database, open_database
from workers.process.exit_status import ExitStatus
from workers.settings.errors import Unavailable
from workers.settings.settings import Settings

pytestmark = pytest.mark.anyio
SIZE = 2
TICKS = 60  # more than a transaction without waiting takes

LEAKING = """
import sys
from psycopg_pool import AsyncConnectionPool
from workers.database import database
from workers.upkeep import dispatcher
from workers.queue import slot

async def forget(self, conn):
    self.__dict__.setdefault("forgotten", []).append(conn)

AsyncConnectionPool.putconn = forget
database.LOOK_S, database.LOOKS = 0.1, 5
sys.exit(dispatcher.main() if sys.argv.pop(1) == "dispatcher" else slot.run_slot("a"))
"""


@pytest.fixture
async def database(database_url: str) -> AsyncIterator[Database]:
    async with open_database(database_url, connections=SIZE, patience_s=5.0) as opened:
        yield opened


async def assert_whole(database: Database) -> None:
    """All connections can be had at once, and none that the pool counts is missing."""
    both = asyncio.Barrier(SIZE)

    async def use() -> None:
        async with database.transaction() as connection:
            await connection.execute("SELECT 1")
            await both.wait()

    async with asyncio.timeout(8):
        await asyncio.gather(*(use() for _ in range(SIZE)))
        while database.pool.lost():  # type: ignore[attr-defined]
            await asyncio.sleep(0.01)


async def use(database: Database) -> None:
    async with database.transaction() as connection:
        await connection.execute("SELECT 1")


async def ended_by_cancellation(work: asyncio.Task[None]) -> None:
    work.cancel()
    with contextlib.suppress(asyncio.CancelledError, Unavailable):
        await work


async def test_a_cancellation_at_any_step_of_a_transaction_costs_no_connection(database: Database):
    for ticks in range(TICKS):
        for others in (0, 3):
            beside = [asyncio.create_task(use(database)) for _ in range(others)]
            work = asyncio.create_task(use(database))
            for _ in range(ticks):
                await asyncio.sleep(0)
            await ended_by_cancellation(work)
            await asyncio.gather(*beside)
    await assert_whole(database)


@pytest.mark.parametrize("ended_by", ["cancellation", "the time limit"])
async def test_the_end_of_patience_while_a_connection_waits_to_be_returned_costs_none(
    database_url: str, ended_by: str
):
    async with open_database(database_url, connections=SIZE, patience_s=5.0, answer_s=0.5) as database:
        await use(database)
        for _ in range(SIZE):
            inside, leave = asyncio.Event(), asyncio.Event()

            async def work(inside: asyncio.Event, leave: asyncio.Event) -> str:
                async with database.transaction() as connection:
                    await connection.execute("SELECT 1")
                    inside.set()
                    await leave.wait()
                return "committed"

            task = asyncio.create_task(work(inside, leave))
            await inside.wait()
            async with database.pool._lock:  # as another task that returns one, for however long
                leave.set()
                await asyncio.sleep(0.2 if ended_by == "cancellation" else 0.8)
                if ended_by == "cancellation":
                    await ended_by_cancellation(task)
            if ended_by == "the time limit":
                assert await task == "committed", "what was committed in time did not fail"
        await assert_whole(database)


async def test_a_client_that_gives_up_waiting_costs_no_connection(database: Database):
    for ticks in range(12):
        async with database.transaction(), database.transaction():
            waiting = asyncio.create_task(use(database))
            await asyncio.sleep(0.01)
        for _ in range(ticks):  # it is handed one, which is tested
            await asyncio.sleep(0)
        await ended_by_cancellation(waiting)
    await assert_whole(database)


async def test_a_cancelled_drain_costs_no_connection(database: Database):
    for ticks in range(6):
        await assert_whole(database)
        draining = asyncio.create_task(database.pool.drain())
        async with database.pool._lock:
            for _ in range(ticks):
                await asyncio.sleep(0)
        await ended_by_cancellation(draining)
    await assert_whole(database)


async def test_a_pool_that_lost_connections_is_broken_once_the_database_answers(
    database_url: str, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(database_module, "LOOK_S", 0.05)
    monkeypatch.setattr(database_module, "LOOKS", 4)
    async with open_database(database_url, connections=SIZE) as database:
        async with database.transaction() as connection:
            await asyncio.sleep(0.5)
            assert not database.broken.is_set(), "one that is lent is not lost"
        for _ in range(20):
            await asyncio.gather(*(use(database) for _ in range(3 * SIZE)))
        assert not database.broken.is_set(), "nor is one that is asked for all the time"
        url, database.url = database.url, "postgresql://postgres@/none?host=/nowhere"
        connection = await AsyncConnectionPool.getconn(database.pool)  # which nobody returns
        await asyncio.sleep(0.5)
        assert not database.broken.is_set(), "a restart does not mend a database that is away"
        database.url = url
        async with asyncio.timeout(10):
            await database.broken.wait()
        await connection.close()


async def test_a_web_process_whose_connections_are_lost_is_not_alive(
    settings: Settings, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(database_module, "LOOK_S", 0.05)
    monkeypatch.setattr(database_module, "LOOKS", 20)
    async with serving(settings) as http:
        assert (await http.get("/livez")).status_code == 200
        monkeypatch.setattr(AsyncConnectionPool, "putconn", lambda *_: asyncio.sleep(0))
        await http.get("/readyz")
        end = time.monotonic() + 20
        while (answer := await http.get("/livez")).status_code == 200:
            assert time.monotonic() < end, "it takes itself for alive"
            await asyncio.sleep(0.1)
        assert (answer.status_code, answer.json()["code"]) == (503, "unavailable")


@pytest.mark.parametrize("process", ["dispatcher", "slot"])
def test_a_process_whose_connections_are_lost_ends(settings: Settings, process: str):
    done = subprocess.run(
        [sys.executable, "-c", LEAKING, process],
        env=environment(settings),
        capture_output=True,
        text=True,
        timeout=60,
    )
    assert done.returncode == ExitStatus.STUCK, done.stderr
    assert "connections to the database, which answers" in done.stderr
