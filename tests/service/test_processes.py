"""Two web processes on one port: the state of a single one must not show."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import sys
import threading
import time
from collections.abc import Iterator
from http.client import HTTPConnection, HTTPException, HTTPResponse
from pathlib import Path
from typing import Any

import httpx
import psutil
import pytest
from prometheus_client.openmetrics.parser import text_string_to_metric_families

from tests.service.conftest import (
    PATIENCE_S,
    PROGRAM,
    Running,
    client_with,
    operator,
    ready_dataset,
    running_service,
    short_folder,
    submit,
)

pytestmark = pytest.mark.server
BURST = 300


@pytest.fixture(scope="module")
def pair() -> Iterator[Running]:
    """A service with two web processes, in which buckets hardly fill up again."""
    settings = {"processes": 2, "auth": "required", "key_requests_burst": BURST, "key_requests_per_s": 0.001}
    with (
        short_folder() as folder,
        running_service(folder, job_command=(sys.executable, str(PROGRAM)), **settings) as running,
    ):
        yield running


class Line:
    """A connection to one of the processes, with a key."""

    def __init__(self, service: Running, key: str) -> None:
        self._http = HTTPConnection(httpx.URL(service.url).netloc.decode(), timeout=60)
        self._headers = {"Authorization": f"Bearer {key}"}

    def ask(self, method: str, path: str, body: Any = None) -> HTTPResponse:
        """The response, its body unread."""
        headers = self._headers | ({"Content-Type": "application/json"} if body is not None else {})
        self._http.request(method, path, None if body is None else json.dumps(body), headers)
        return self._http.getresponse()

    def status(self, method: str, path: str, body: Any = None) -> int:
        answer = self.ask(method, path, body)
        answer.read()
        return answer.status


def web_processes(service: Running) -> list[psutil.Process]:
    """Both, once they are up."""
    end = time.monotonic() + PATIENCE_S
    while True:
        found = []
        for child in psutil.Process(service.process.pid).children(recursive=True):
            with contextlib.suppress(psutil.Error):
                # Until it listens it may still be the program that ties it to its parent.
                if "service.server" in child.cmdline() and "die_with" not in " ".join(child.cmdline()):
                    found.append(child)
        if len(found) == 2 and service.log.read_text().count("listening on") >= 2:
            return found
        assert time.monotonic() < end
        time.sleep(0.05)


def line_to(service: Running, process: psutil.Process, key: str) -> Line:
    """A connection that this process has taken: the other one is asleep meanwhile."""
    others = [other for other in web_processes(service) if other != process]
    for other in others:
        other.suspend()
    try:
        line = Line(service, key)
        assert line.status("GET", "/livez") == 200
        return line
    finally:
        for other in others:
            other.resume()


@pytest.fixture
def lines(pair: Running) -> tuple[Line, Line]:
    """A connection to each process, with the same new key."""
    key = operator(pair.data_dir, "keys", "create", "k", "--scope", "admin")["key"]
    one, other = web_processes(pair)
    return line_to(pair, one, key), line_to(pair, other, key)


def figures(line: Line) -> dict[str, float]:
    """Samples by name and labels, from whichever process answers."""
    line._headers["Accept"] = "application/openmetrics-text; version=1.0.0"
    text = line.ask("GET", "/metrics").read().decode()
    return {
        f"{sample.name} {sorted(sample.labels.items())}": sample.value
        for family in text_string_to_metric_families(text)
        for sample in family.samples
    }


def test_a_key_has_its_burst_once_whichever_process_it_reaches(lines: tuple[Line, Line]) -> None:
    statuses = [lines[n % 2].status("GET", "/v1/jobs?limit=1") for n in range(BURST + 20)]
    assert [statuses.count(status) for status in (200, 429)] == [BURST, 20]
    assert statuses[-20:] == [429] * 20


def test_each_process_tells_the_figures_of_both_and_none_is_lost_with_one(
    pair: Running, lines: tuple[Line, Line]
) -> None:
    counted = "biresnerf_http_requests_total [('method', 'GET'), ('route', '/v1/info'), ('status', '200')]"
    before = figures(lines[0]).get(counted, 0)
    for n in range(7):
        assert lines[n % 2].status("GET", "/v1/info") == 200
    told = [figures(line) for line in lines]
    assert [found[counted] - before for found in told] == [7, 7]
    resident = [name for name in told[0] if name.startswith("process_resident_memory_bytes")]
    pids = [process.pid for process in web_processes(pair)]
    assert resident == [f"process_resident_memory_bytes [('pid', '{pid}')]" for pid in sorted(pids)]
    psutil.Process(pids[1]).kill()
    assert figures(lines[0])[counted] - before == 7
    while pids[1] in (now := [process.pid for process in web_processes(pair)]):
        time.sleep(0.05)
    (new,) = set(now) - set(pids)
    key = operator(pair.data_dir, "keys", "create", "k", "--scope", "admin")["key"]
    assert figures(line_to(pair, psutil.Process(new), key))[counted] - before == 7


def test_listeners_at_both_processes_hear_the_same_and_go_on_at_the_other(
    pair: Running, lines: tuple[Line, Line], scene: Path
) -> None:
    key = lines[0]._headers["Authorization"].split()[1]
    with client_with(pair, key) as http:
        job = submit(http, ready_dataset(http, scene), steps=60, step_ms=20)["id"]
        asker = line_to(pair, web_processes(pair)[0], key)
        streams = [line.ask("GET", f"/v1/jobs/{job}/events") for line in lines]
        first = [next(_ids(stream)) for stream in streams]
        assert figures(asker)["biresnerf_event_listeners []"] == 2
        web_processes(pair)[1].kill()
        heard = [[start, *_ids(stream)] for start, stream in zip(first, streams, strict=True)]
        end = http.get(f"/v1/jobs/{job}?wait=30").json()
        assert end["state"] == "succeeded"
        assert figures(Line(pair, key))["biresnerf_event_listeners []"] == 0
        whole = [event["seq"] for event in _events(http, job, 0)]
        assert whole == list(range(1, len(whole) + 1))
        assert heard[0] == whole
        # The other stream ended with its process; the client goes on where it ended.
        rest = [event["seq"] for event in _events(http, job, heard[1][-1])]
        assert heard[1] + rest == whole
        assert rest


def _ids(stream: HTTPResponse) -> Iterator[int]:
    with contextlib.suppress(OSError):  # its process may be killed
        for line in stream:
            if line.startswith(b"id: "):
                yield int(line[4:])


def _events(http: httpx.Client, job: str, after: int) -> list[dict[str, Any]]:
    text = http.get(f"/v1/jobs/{job}/events", headers={"Last-Event-ID": str(after)}).text
    data = [block for block in text.split("\n\n") if block.startswith("id: ")]
    return [json.loads(block.split("data: ")[1]) for block in data]


def test_each_process_is_replaced_and_no_request_is_lost(pair: Running) -> None:
    """Clients that keep their connections and send nothing twice, while one process after the other is stopped."""
    done, failed, over = [], [], threading.Event()

    def send(key: str) -> None:
        line = Line(pair, key)
        while not over.is_set() and len(done) < 4 * BURST:
            try:
                done.append(line.status("POST", "/v1/datasets", {"name": "restart"}))
            except (OSError, HTTPException) as error:
                failed.append(repr(error))
                line = Line(pair, key)
            time.sleep(0.01)

    keys = [operator(pair.data_dir, "keys", "create", "k")["key"] for _ in range(6)]
    clients = [threading.Thread(target=send, args=(key,)) for key in keys]
    for client in clients:
        client.start()
    for process in web_processes(pair):
        time.sleep(0.3)
        os.kill(process.pid, signal.SIGTERM)
        process.wait(30)
        sent = len(done)
        while len(done) == sent:
            time.sleep(0.01)
        web_processes(pair)
    time.sleep(1.0)
    over.set()
    for client in clients:
        client.join()
    assert failed == []
    assert set(done) == {201}
    assert len(done) > 50
    listed, cursor = 0, ""
    with client_with(pair, operator(pair.data_dir, "keys", "create", "k", "--scope", "admin")["key"]) as http:
        while cursor is not None:
            page = http.get(f"/v1/datasets?limit=200{cursor and '&cursor='}{cursor}").json()
            listed += sum(item["name"] == "restart" for item in page["items"])
            cursor = page["next_cursor"]
    assert listed == len(done)
