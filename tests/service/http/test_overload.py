"""More requests than one process can take at once: what it says to whom it turns away."""

from __future__ import annotations

import asyncio
from pathlib import Path

import pytest

from service.http.dependencies import Service
from service.http.problems import RETRY_AFTER_S
from tests.service.conftest import problem
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
