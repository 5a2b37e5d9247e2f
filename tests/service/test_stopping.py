"""The responses of a stopping service to waiting clients."""

from __future__ import annotations

import asyncio
import json
import signal
from http.client import HTTPConnection
from types import SimpleNamespace
from typing import Any

import httpx
import pytest

from biresnerf.client import Client
from service.http.request_context import RequestContext
from tests.service.conftest import Running, finished, ready_dataset, submit
from tests.service.routes.test_events import until_ready, web_process

pytestmark = pytest.mark.server


def test_a_long_poll_is_answered_when_the_service_stops(
    http: httpx.Client, service: Running, scene: Any
) -> None:
    job = submit(http, ready_dataset(http, scene), steps=400, step_ms=50)
    waiting = HTTPConnection(httpx.URL(service.url).netloc.decode(), timeout=30)
    waiting.request("GET", f"/v1/jobs/{job['id']}?wait=60")
    http.get("/readyz")  # came later, so once it is answered the other one is under way
    server = web_process(service)
    server.send_signal(signal.SIGTERM)
    answer = waiting.getresponse()
    state = json.loads(answer.read())["state"]
    server.wait(10)
    with Client(service.url) as client:
        until_ready(client)
    http.post(job["links"]["cancel"])
    finished(http, job["id"])
    assert (answer.status, state in ("queued", "running")) == (200, True)


def test_a_listener_is_told_to_come_back_when_the_service_stops(
    http: httpx.Client, service: Running, scene: Any
) -> None:
    job = submit(http, ready_dataset(http, scene), steps=400, step_ms=50)
    server = web_process(service)
    with http.stream("GET", job["links"]["events"]) as listening:
        lines = listening.iter_lines()
        assert next(line for line in lines if line.startswith("event: "))
        server.send_signal(signal.SIGTERM)
        rest = list(lines)
    server.wait(10)
    with Client(service.url) as client:
        until_ready(client)
    http.post(job["links"]["cancel"])
    finished(http, job["id"])
    goodbye, retry, end = rest[-3:]
    assert goodbye == ": this process is stopping; connect again with the last event's id"
    assert 500 <= int(retry.removeprefix("retry: ")) <= 2500
    assert end == ""


@pytest.mark.parametrize("stopping", [True, False])
def test_what_a_stopping_service_cuts_off_can_be_asked_again(stopping: bool) -> None:
    sent: list[dict[str, Any]] = []

    async def never_answers(*_: Any) -> None:
        await asyncio.sleep(60)

    async def send(message: Any) -> None:
        sent.append(message)

    async def cut_off() -> None:
        closing = asyncio.Event()
        app = SimpleNamespace(state=SimpleNamespace(service=SimpleNamespace(closing=closing)))
        scope = {"type": "http", "http_version": "1.1", "method": "GET", "path": "/v1/jobs", "headers": []}
        scope |= {"raw_path": b"/v1/jobs", "query_string": b"", "app": app}
        serving = asyncio.create_task(RequestContext(never_answers)(scope, None, send))  # type: ignore[arg-type]
        await asyncio.sleep(0.01)
        if stopping:
            closing.set()
        serving.cancel()
        await asyncio.gather(serving, return_exceptions=True)

    asyncio.run(cut_off())
    assert [message["status"] for message in sent if "status" in message] == ([503] if stopping else [])
