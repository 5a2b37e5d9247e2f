"""More requests than one process accepts at once: its responses to those refused."""

from __future__ import annotations

import asyncio
from pathlib import Path

import pytest

from service.http.dependencies import JSON_BYTES_AT_ONCE, Service
from service.http.problems import RETRY_AFTER_S
from tests.service.conftest import MIB, problem
from tests.service.in_process import serving
from tests.workers.conftest import anyio_backend, database_url, quick_settings, server

__all__ = ["anyio_backend", "database_url", "server"]
pytestmark = pytest.mark.anyio


async def test_clients_turned_away_together_are_not_told_to_come_back_together(
    database_url: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    async with serving(quick_settings(tmp_path / "data", database_url=database_url)) as http:
        service: Service = http._transport.app.state.service
        pool = service.stores.keys._database.pool
        assert (await http.get("/v1/jobs")).status_code == 200
        monkeypatch.setattr(pool, "timeout", 1.0)
        taken = [await pool.getconn() for _ in range(pool.max_size)]
        try:
            answers = await asyncio.gather(*(http.get("/v1/jobs") for _ in range(60)))
        finally:
            for connection in taken:
                await pool.putconn(connection)
    for answer in answers:
        problem(answer, 503, "database_unavailable")
    waits = sorted(int(answer.headers["retry-after"]) for answer in answers)
    assert RETRY_AFTER_S[0] <= waits[0] < 5 < 9 < waits[-1] <= RETRY_AFTER_S[1]
    assert max(waits.count(wait) for wait in set(waits)) < 20


async def test_large_json_bodies_under_way_are_limited_and_usual_ones_pass(database_url: str, tmp_path: Path):
    settings = quick_settings(tmp_path / "data", database_url=database_url, auth="required")
    async with serving(settings) as http:
        service: Service = http._transport.app.state.service
        keys = [
            await service.stores.keys.create("anna", name, ["admin"]) for name in ("mine", "other", "third")
        ]
        mine, other, third = (
            {"Authorization": f"Bearer {text}", "Content-Type": "application/json"} for _, text in keys
        )
        go_on, arrived = asyncio.Event(), 0
        size = 2 * MIB

        async def all_but_the_end():
            nonlocal arrived
            yield b'{"manifest": []' + b" " * size
            arrived += 1
            await go_on.wait()
            yield b"}"

        def send(headers: dict[str, str]):
            return asyncio.create_task(http.post("/v1/datasets", headers=headers, content=all_but_the_end()))

        at_once = JSON_BYTES_AT_ONCE // size // 2  # of one client
        first = [send(mine) for _ in range(at_once)]
        while arrived < at_once:
            await asyncio.sleep(0.01)
        told = await asyncio.wait_for(send(mine), 30)
        problem(told, 429, "too_many_uploads")
        assert told.headers["retry-after"]
        assert (await http.post("/v1/datasets", headers=mine, json={"name": "usual"})).status_code == 201
        second = [send(other) for _ in range(at_once)]
        while arrived < 2 * at_once:
            await asyncio.sleep(0.01)
        problem(await asyncio.wait_for(send(third), 30), 429, "too_many_uploads")
        assert (await http.post("/v1/datasets", headers=other, json={"name": "usual"})).status_code == 201
        first.pop().cancel()  # goes away in mid body
        go_on.set()
        for answer in await asyncio.gather(*first, *second):
            assert answer.status_code == 201, answer.text
        assert service.bodies._held == {}
