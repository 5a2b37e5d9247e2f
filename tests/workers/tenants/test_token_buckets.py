"""Rate limits in a real database."""

from __future__ import annotations

import asyncio
from datetime import timedelta

import psycopg
import pytest

from workers.engine import Stores
from workers.settings.settings import Settings
from workers.tenants.token_buckets import forget_full_buckets

pytestmark = [pytest.mark.server, pytest.mark.anyio]


def let_time_pass(settings: Settings, seconds: float) -> None:
    """For all buckets."""
    with psycopg.connect(settings.database_url) as connection:
        connection.execute("UPDATE token_buckets SET full_at = full_at - %s", (timedelta(seconds=seconds),))


async def test_a_bucket_lets_its_burst_through_and_then_its_rate(stores: Stores, settings: Settings) -> None:
    async def passes(client: str) -> bool:
        return not (await stores.buckets.take("key", client, 0.01, 3)).wait_s

    assert [await passes("a") for _ in range(4)] == [True, True, True, False]
    assert await passes("b")
    let_time_pass(settings, 100.0)
    assert [await passes("a") for _ in range(2)] == [True, False]
    let_time_pass(settings, 10_000.0)
    level = await stores.buckets.take("key", "a", 0.01, 3)
    assert (int(level.tokens), level.wait_s) == (2, 0.0)
    assert 99.0 < level.full_in_s <= 100.0


async def test_who_is_refused_learns_when_to_come_again_and_loses_nothing_by_asking(stores: Stores) -> None:
    for _ in range(2):
        await stores.buckets.take("key", "a", 0.01, 2)
    for _ in range(5):
        refused = await stores.buckets.take("key", "a", 0.01, 2)
        assert 90.0 < refused.wait_s <= 100.0


async def test_of_many_requests_at_once_exactly_the_burst_passes(stores: Stores) -> None:
    taken = await asyncio.gather(*(stores.buckets.take("key", "a", 0.01, 10) for _ in range(40)))
    assert sum(not level.wait_s for level in taken) == 10


async def test_only_buckets_that_are_not_full_are_remembered(stores: Stores, settings: Settings) -> None:
    await stores.buckets.take("key", "a", 0.01, 3)
    let_time_pass(settings, 1000.0)
    await stores.buckets.take("key", "b", 0.01, 3)
    with psycopg.connect(settings.database_url) as connection:
        assert connection.execute("SELECT count(*) FROM token_buckets").fetchone() == (2,)
    await stores.buckets._database.run(forget_full_buckets)
    with psycopg.connect(settings.database_url) as connection:
        assert connection.execute("SELECT client FROM token_buckets").fetchall() == [("b",)]
