"""The types of both clients as their users see them. Never runs: `make lint` has mypy check it.

An ignore that ignores nothing is an error there, so the calls marked with one must be refused.
"""

from __future__ import annotations

from collections.abc import AsyncIterator, Iterator
from pathlib import Path
from typing import assert_type

from biresnerf.client import AsyncClient, Client, StreamEvent
from biresnerf.wire.jobs import JobView
from biresnerf.wire.webhooks import DeliveryView


def blocking(client: Client) -> None:
    assert_type(client.submit(Path("photos"), {"preset": "fast"}, labels={"run": "a"}), JobView)
    assert_type(client.wait("job_1", lambda job: job.stage, timeout_s=1.0), JobView)
    assert_type(client.events("job_1"), Iterator[StreamEvent])
    assert_type(client.download_all("job_1", Path("out")), list[Path])
    assert_type(client.deliveries("whk_1", limit=3), list[DeliveryView])
    client.submit("photos")  # type: ignore[arg-type]
    client.job("job_1", stage=2)  # type: ignore[call-arg]


async def asynchronous(client: AsyncClient) -> None:
    assert_type(await client.submit(Path("photos")), JobView)
    assert_type(client.events("job_1"), AsyncIterator[StreamEvent])
    await client.job(1)  # type: ignore[arg-type]
