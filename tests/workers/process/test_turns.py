"""Whose turn it is, where heavy work is done a few at a time."""

from __future__ import annotations

import asyncio

import pytest

from workers.process.turns import Turns

pytestmark = pytest.mark.anyio


async def settled() -> None:
    for _ in range(10):
        await asyncio.sleep(0)


class Workshop:
    """Turns of which each lasts until it is told to end; notes in which order they began."""

    def __init__(self, at_once: int) -> None:
        self._turns = Turns(at_once)
        self.began: list[str] = []
        self._ends: list[asyncio.Event] = []

    async def ask(self, tenant: str) -> asyncio.Task[None]:
        task = asyncio.create_task(self._turn(tenant))
        await settled()
        return task

    async def end(self, which: int) -> None:
        self._ends[which].set()
        await settled()

    async def _turn(self, tenant: str) -> None:
        async with self._turns.turn(tenant):
            self.began.append(tenant)
            self._ends.append(asyncio.Event())
            await self._ends[-1].wait()


async def test_many_of_one_tenant_delay_another_by_one():
    shop = Workshop(1)
    asked = [await shop.ask(tenant) for tenant in "AAAAABBC"]
    for n in range(8):
        await shop.end(n)
    await asyncio.gather(*asked)
    assert "".join(shop.began) == "AABCABAA"


async def test_so_many_at_once_and_no_more():
    shop = Workshop(2)
    asked = [await shop.ask("A") for _ in range(5)]
    assert len(shop.began) == 2
    await shop.end(1)
    assert len(shop.began) == 3
    for n in (0, 2, 3, 4):
        await shop.end(n)
    await asyncio.gather(*asked)


async def test_who_gives_up_takes_no_turn_and_loses_none():
    shop = Workshop(1)
    first, gone, late = [await shop.ask(tenant) for tenant in "ABC"]
    gone.cancel()
    await settled()
    # The turn is passed on to the last one in the moment in which it gives up as well.
    shop._ends[0].set()
    await asyncio.sleep(0)
    late.cancel()
    await asyncio.gather(first, gone, late, return_exceptions=True)
    assert gone.cancelled()
    assert late.cancelled()
    after = await shop.ask("D")
    assert shop.began == ["A", "D"]
    await shop.end(1)
    await after
