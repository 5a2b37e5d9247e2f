from __future__ import annotations

import contextlib
import json
import os
import signal
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import psutil
import pytest

from biresnerf.client import Client
from service.routes.events import RETRY_MS
from tests.service.conftest import PATIENCE_S, Running, finished, problem, ready_dataset, submit, until


@pytest.fixture(scope="session")
def dataset(service: Running, scene: Path) -> str:
    with httpx.Client(base_url=service.url, timeout=60.0) as client:
        return ready_dataset(client, scene)


def events(http: httpx.Client, job: dict[str, Any], **arguments: Any) -> Iterator[dict[str, str]]:
    """The messages of a stream until it ends, by an own reading of the format."""
    with http.stream("GET", job["links"]["events"], **arguments) as answer:
        assert answer.status_code == 200
        assert answer.headers["content-type"].startswith("text/event-stream")
        assert answer.headers["x-accel-buffering"] == "no"
        message: dict[str, str] = {}
        for line in answer.iter_lines():
            if not line:
                if "data" in message:
                    yield message
                message = {}
                continue
            name, value = line.split(": ", 1)
            message[name] = value


def test_a_stream_tells_the_whole_story_and_ends(http: httpx.Client, dataset: str) -> None:
    job = submit(http, dataset, steps=60, step_ms=60)
    seen = list(events(http, job))
    numbered = [message for message in seen if "id" in message]
    assert [int(message["id"]) for message in numbered] == list(range(1, len(numbered) + 1))
    kinds = [message["event"] for message in numbered]
    assert kinds[:2] == ["queued", "started"]
    assert kinds[-1] == "succeeded" == seen[-1]["event"]
    stages = [
        json.loads(message["data"])["data"]["stage"] for message in numbered if message["event"] == "stage"
    ]
    assert stages == ["preparing", "coarse", "fine", "exporting"]
    progress = [json.loads(message["data"]) for message in seen if message["event"] == "progress"]
    fractions = [job["progress"]["fraction"] for job in progress]
    assert fractions == sorted(fractions)
    assert fractions[-1] == 1.0
    assert any(0 < fraction < 1 for fraction in fractions)
    assert progress[-1]["state"] == "succeeded"


def test_a_stream_is_replayed_from_any_event(http: httpx.Client, done_job: dict[str, Any]) -> None:
    whole = [message for message in events(http, done_job) if "id" in message]
    middle = whole[2]["id"]
    expected = whole[3:]
    assert [m for m in events(http, done_job, headers={"Last-Event-ID": middle}) if "id" in m] == expected
    assert [m for m in events(http, done_job, params={"after": middle}) if "id" in m] == expected
    both = events(http, done_job, params={"after": 0}, headers={"Last-Event-ID": middle})
    assert [m for m in both if "id" in m] == expected
    nothing = list(events(http, done_job, params={"after": whole[-1]["id"]}))
    assert [message["event"] for message in nothing] == ["progress"]


def test_streams_that_end_together_are_not_told_to_come_back_together(
    http: httpx.Client, done_job: dict[str, Any]
) -> None:
    told = [http.get(done_job["links"]["events"]).text.splitlines()[0] for _ in range(8)]
    waits = {int(line.removeprefix("retry: ")) for line in told}
    assert len(waits) > 4
    assert all(RETRY_MS[0] <= wait <= RETRY_MS[1] for wait in waits)


def test_bad_starts_and_missing_jobs_are_problems_not_streams(
    http: httpx.Client, done_job: dict[str, Any]
) -> None:
    url = done_job["links"]["events"]
    problem(http.get(url, headers={"Last-Event-ID": "last"}), 422, "invalid_request")
    problem(http.get(url, params={"after": -1}), 422, "invalid_request")
    problem(http.get("/v1/jobs/job_00000000000000000000000000/events"), 404, "not_found")
    problem(http.get("/v1/jobs/a%00b/events"), 404, "not_found")


def test_many_followers_and_a_follower_that_leaves_do_not_disturb(http: httpx.Client, dataset: str) -> None:
    job = submit(http, dataset, steps=40, step_ms=50)
    leaving = events(http, job)
    next(leaving)
    leaving.close()
    assert [m["event"] for m in events(http, job)][-1] == "succeeded"


def test_following_goes_on_through_the_death_of_the_web_process(
    http: httpx.Client, service: Running, dataset: str
) -> None:
    job = submit(http, dataset, steps=100, step_ms=50)
    seen, killed = [], False
    with Client(service.url) as client:
        for happening in client.events(job["id"]):
            seen.append(happening)
            if not killed and happening.kind == "progress" and happening.data["stage"] == "coarse":
                os.kill(web_process(service).pid, signal.SIGKILL)
                killed = True
    numbers = [happening.data["seq"] for happening in seen if happening.kind != "progress"]
    assert killed
    assert numbers == list(range(1, len(numbers) + 1))
    assert seen[-1].kind == "succeeded"
    until(http, job["id"], lambda found: found["attempt"] == 1)


def test_a_stream_cut_off_by_kills_of_the_web_process_is_replayed_from_the_last_event_that_came(
    http: httpx.Client, service: Running, dataset: str
) -> None:
    job = submit(http, dataset, steps=110, step_ms=50)
    seen: list[dict[str, str]] = []
    kills = 0
    while not seen or seen[-1]["event"] != "succeeded":
        headers = {"Last-Event-ID": seen[-1]["id"]} if seen else {}
        with contextlib.suppress(httpx.TransportError):
            for message in events(http, job, headers=headers):
                if "id" in message:
                    seen.append(message)
                if kills < 2 and message["event"] == "progress" and json.loads(message["data"])["stage"]:
                    os.kill(web_process(service).pid, signal.SIGKILL)
                    kills += 1
        with Client(service.url) as client:
            until_ready(client)
    assert kills == 2
    assert [int(message["id"]) for message in seen] == list(range(1, len(seen) + 1)), "each event came once"
    assert seen == [message for message in events(http, job) if "id" in message], "and as it is told later"
    assert http.get(job["links"]["self"]).json()["attempt"] == 1, "the job noticed nothing"


def web_process(service: Running) -> psutil.Process:
    (found,) = [
        child
        for child in psutil.Process(service.process.pid).children(recursive=True)
        if "service.server" in child.cmdline()
    ]
    return found


def test_a_stopping_service_does_not_wait_for_its_followers(
    http: httpx.Client, service: Running, dataset: str
) -> None:
    job = submit(http, dataset, steps=2000, step_ms=50)
    following = events(http, job)
    next(following)
    server = web_process(service)
    server.send_signal(signal.SIGTERM)
    for _ in following:
        pass
    server.wait(PATIENCE_S)
    with Client(service.url) as client:
        until_ready(client)
    assert http.get(job["links"]["self"]).json()["state"] in {"queued", "running"}, (
        "it did not wait for the end"
    )
    http.post(job["links"]["cancel"])
    finished(http, job["id"])


def until_ready(client: Client) -> None:
    end = time.monotonic() + PATIENCE_S
    while not client.ready():
        assert time.monotonic() < end
        time.sleep(0.1)
