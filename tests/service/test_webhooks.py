from __future__ import annotations

import http.server
import threading
import time
from collections.abc import Iterator
from typing import Any

import httpx
import pytest
import standardwebhooks

from tests.service.conftest import problem

PATIENCE_S = 20.0


class Receiver(http.server.ThreadingHTTPServer):
    """A real receiver that keeps what it hears."""

    def __init__(self) -> None:
        super().__init__(("127.0.0.1", 0), _Handler)
        self.heard: list[tuple[dict[str, str], bytes]] = []
        self.url = f"http://127.0.0.1:{self.server_address[1]}/in"


class _Handler(http.server.BaseHTTPRequestHandler):
    server: Receiver

    def do_POST(self) -> None:
        body = self.rfile.read(int(self.headers["content-length"]))
        self.server.heard.append((dict(self.headers), body))
        self.send_response(204)
        self.end_headers()

    def log_message(self, format: str, *args: Any) -> None:
        pass


@pytest.fixture
def receiver() -> Iterator[Receiver]:
    with Receiver() as server:
        thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.05})
        thread.start()
        yield server
        server.shutdown()
        thread.join()


@pytest.fixture
def webhook(http: httpx.Client, receiver: Receiver) -> Iterator[dict[str, Any]]:
    answer = http.post("/v1/webhooks", json={"url": receiver.url, "description": "ä"})
    assert answer.status_code == 201, answer.text
    assert answer.headers["location"] == answer.json()["links"]["self"]
    yield answer.json()
    http.delete(answer.json()["links"]["self"])


def delivered(http: httpx.Client, href: str) -> dict[str, Any]:
    end = time.monotonic() + PATIENCE_S
    while (found := http.get(href).json())["state"] == "pending":
        assert time.monotonic() < end, found
        time.sleep(0.03)
    return found


def test_a_test_message_arrives_and_is_in_the_log(
    http: httpx.Client, webhook: dict[str, Any], receiver: Receiver
) -> None:
    answer = http.post(webhook["links"]["test"])
    assert answer.status_code == 202
    found = delivered(http, answer.headers["location"])
    assert (found["state"], found["event"]) == ("delivered", "webhook.test")
    assert [attempt["status"] for attempt in found["attempts"]] == [204]
    ((headers, body),) = receiver.heard
    assert standardwebhooks.Webhook(webhook["secret"]).verify(body, headers)["type"] == "webhook.test"
    assert found["body"] == body.decode()
    again = http.post(found["links"]["redeliver"])
    assert (again.status_code, again.json()["id"]) == (202, found["id"])
    assert len(delivered(http, found["links"]["self"])["attempts"]) == 2
    listed = http.get(webhook["links"]["deliveries"]).json()["items"]
    assert [item["id"] for item in listed] == [found["id"]]


def test_the_secret_is_told_once(http: httpx.Client, webhook: dict[str, Any]) -> None:
    assert webhook["secret"].startswith("whsec_")
    for path in ("/v1/webhooks", webhook["links"]["self"], webhook["links"]["deliveries"]):
        assert webhook["secret"] not in http.get(path).text
    renewed = http.post(webhook["links"]["rotate"])
    assert renewed.status_code == 200
    assert renewed.json()["secret"] not in ("", webhook["secret"])
    assert renewed.json()["previous_secret_until"] is not None
    assert "whsec_" not in http.get(webhook["links"]["self"]).text


def test_a_webhook_is_changed_switched_off_and_deleted(http: httpx.Client, webhook: dict[str, Any]) -> None:
    here = webhook["links"]["self"]
    changed = http.patch(here, json={"events": ["job.failed"], "enabled": False}).json()
    assert (changed["events"], changed["enabled"], changed["url"]) == (["job.failed"], False, webhook["url"])
    problem(http.post(webhook["links"]["test"]), 409, "state_conflict")
    assert http.delete(here).status_code == 204
    problem(http.get(here), 404, "not_found")
    problem(http.delete(here), 404, "not_found")


@pytest.mark.parametrize("url", ["ftp://a.example/", "http://10.0.0.1/", "http://user@a.example/", "x", ""])
def test_an_address_that_cannot_be_used_is_refused_with_the_reason(http: httpx.Client, url: str) -> None:
    problem(http.post("/v1/webhooks", json={"url": url}), 422, "webhook_url_refused")


@pytest.mark.parametrize(
    "change",
    [{"events": []}, {"events": ["job.exploded"]}, {"url": 7}, {"secret": "mine"}, {"url": "x" * 3000}],
)
def test_a_body_that_does_not_fit_is_refused_with_its_pointer(
    http: httpx.Client, change: dict[str, Any], receiver: Receiver
) -> None:
    told = problem(http.post("/v1/webhooks", json={"url": receiver.url, **change}), 422, "invalid_request")
    (name,) = change
    assert told["errors"][0]["pointer"].startswith(f"#/{name}")


def test_unknown_and_odd_ids_are_404(http: httpx.Client, webhook: dict[str, Any]) -> None:
    for path in ("wh_0", "%00", "x" * 100, "wh_0/deliveries"):
        problem(http.get(f"/v1/webhooks/{path}"), 404, "not_found")
    problem(http.get(webhook["links"]["deliveries"] + "/msg_0"), 404, "not_found")
    problem(http.post(webhook["links"]["deliveries"] + "/msg_0/redeliver"), 404, "not_found")
