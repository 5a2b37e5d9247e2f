"""A list of two thousand jobs opens as one of twenty: it asks for its first page, and nothing looks at all of them."""

from __future__ import annotations

import asyncio
import statistics
import sys
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import httpx
import pytest
from playwright.sync_api import Page, expect

from biresnerf.client import Client
from tests.service.conftest import PROGRAM, Running
from tests.web.watched import Watched
from tests.workers.database.full_tables import Copies
from workers.database.database import open_database
from workers.database.embedded_postgres import EmbeddedPostgres
from workers.settings.settings import Settings

FEW, MANY, TRIES = 20, 2000, 5


pytestmark = pytest.mark.jobs_by(PROGRAM)


async def copy(url: str, job: str, there: int, count: int) -> None:
    async with open_database(url, connections=1) as database:
        copies = Copies(database, job)
        copies.made = there
        await copies.make(count)
        await database.fetch("ANALYZE jobs")


def seconds(work: Callable[[], object]) -> float:
    """Of several tries the median."""
    times = []
    for _ in range(TRIES):
        began = time.monotonic()
        work()
        times.append(time.monotonic() - began)
    return statistics.median(times)


def opened(page: Page, url: str) -> int:
    """How many jobs the page shows at first."""
    page.goto("about:blank")
    page.goto(url)
    page.locator(".job-card").nth(FEW - 1).wait_for()
    return page.locator(".job-card").count()


def test_two_thousand_jobs_open_with_the_requests_of_twenty(
    tab: Watched, service: Running, api: httpx.Client, kitchen: Path
) -> None:
    """Prints the seconds, too, which docs/scaling.md has."""
    page, asked = tab.page, list[str]()
    page.on("request", lambda request: asked.append(request.url))
    with Client(service.url) as client:
        job = client.wait(client.submit(kitchen, {"preset": "fast", "steps": 20, "threads": 77}).id)
    url = EmbeddedPostgres(Settings(data_dir=service.data_dir).postgres_dir).url
    lists, pages, requests = {}, {}, {}
    with ThreadPoolExecutor(1) as aside:  # Playwright's own loop runs in this thread
        for there, count in ((0, FEW), (FEW, MANY)):
            aside.submit(asyncio.run, copy(url, job.id, there, count)).result()
            assert opened(page, service.url) <= FEW + 4, "the first page of the list"
            lists[count] = seconds(lambda: api.get("/jobs?limit=24").raise_for_status())
            asked.clear()
            pages[count] = seconds(lambda: opened(page, service.url))
            requests[count] = sum("/v1/jobs?" in one for one in asked) / TRIES
    sys.stdout.write(f"list {lists}, page {pages}, requests {requests}\n")
    assert requests[MANY] <= requests[FEW] + 1, "those that run, which may be older"
    page.get_by_role("searchbox").fill("kitchen")
    expect(page.get_by_text("of the newest 1000")).to_be_visible()
