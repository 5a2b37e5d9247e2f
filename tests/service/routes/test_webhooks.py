from __future__ import annotations

import http.server
import json
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest
import standardwebhooks

from tests.service.conftest import finished, problem, ready_dataset, scene_files, submit, zip_of

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
    renamed = http.patch(here, json={"description": "poses", "enabled": None})
    assert renamed.status_code == 200, renamed.text
    assert (renamed.json()["description"], renamed.json()["enabled"]) == ("poses", True)
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


SECRET = "whsec_" + "QUJD" * 8


@pytest.mark.parametrize("form", [False, True])
def test_a_webhook_sent_along_with_a_job_hears_of_its_end_and_of_no_other(
    http: httpx.Client, receiver: Receiver, scene: Path, form: bool
) -> None:
    wanted = {"url": receiver.url, "secret": SECRET}
    options = {"preset": "fast", "steps": 20, "seed": 5}
    headers = {"Idempotency-Key": f"hook-{form}-{receiver.url}"}

    def send(webhook: dict[str, Any]) -> httpx.Response:
        if not form:
            body = {"dataset_id": dataset, "options": options, "webhook": webhook}
            return http.post("/v1/jobs", json=body, headers=headers)
        texts = {"options": json.dumps(options), "webhook": json.dumps(webhook)}
        return http.post("/v1/jobs", files={"archive": archive}, data=texts, headers=headers)

    archive = ("a.zip", zip_of(scene_files(scene)))
    dataset = "" if form else ready_dataset(http, scene)
    answer = send(wanted)
    assert answer.status_code == 202, answer.text
    job = answer.json()
    assert SECRET not in answer.text
    other = submit(http, job["dataset_id"])
    for found in (job, other):
        assert finished(http, found["id"])["state"] == "succeeded"
    (webhook,) = http.get("/v1/webhooks", params={"job": job["id"]}).json()["items"]
    assert (webhook["job_id"], webhook["events"][0]) == (job["id"], "job.succeeded")
    (delivery,) = http.get(webhook["links"]["deliveries"]).json()["items"]
    assert delivered(http, delivery["links"]["self"])["state"] == "delivered"
    ((heard, body),) = receiver.heard
    assert standardwebhooks.Webhook(SECRET).verify(body, heard)["data"]["id"] == job["id"]
    assert send(wanted).json()["id"] == job["id"], "the same request again is the same job"
    problem(send({**wanted, "events": ["job.failed"]}), 422, "idempotency_key_reused")
    assert webhook["id"] not in http.get("/v1/webhooks").text
    assert http.delete(job["links"]["self"]).status_code == 204
    problem(http.get(webhook["links"]["self"]), 404, "not_found")


def test_a_webhook_sent_along_with_a_batch_hears_once_that_all_is_over(
    http: httpx.Client, receiver: Receiver, scene: Path
) -> None:
    dataset = ready_dataset(http, scene)
    job = {"dataset_id": dataset, "options": {"preset": "fast", "steps": 20, "seed": 5}}
    failing = {**job, "options": {**job["options"], "threads": 77}}
    body = {"jobs": [job, failing, job], "webhook": {"url": receiver.url, "secret": SECRET}}
    batch = http.post("/v1/batches", json=body).json()
    for one in batch["jobs"]:
        finished(http, one["id"])
    over = http.get(batch["links"]["self"]).json()
    assert over["counts"] == {"succeeded": 2, "failed": 1}
    (webhook,) = http.get("/v1/webhooks", params={"job": batch["id"]}).json()["items"]
    (delivery,) = http.get(webhook["links"]["deliveries"]).json()["items"]
    assert delivered(http, delivery["links"]["self"])["state"] == "delivered"
    ((heard, content),) = receiver.heard
    told = standardwebhooks.Webhook(SECRET).verify(content, heard)
    assert (told["type"], told["data"]["id"], told["data"]["counts"]) == (
        "batch.finished",
        batch["id"],
        over["counts"],
    )


@pytest.mark.parametrize(
    ("change", "code"),
    [
        ({"url": "http://10.0.0.1/"}, "webhook_url_refused"),
        ({"secret": "whsec_short"}, "invalid_request"),
        ({"secret": None}, "invalid_request"),
        ({"events": ["dataset.exploded"]}, "invalid_request"),
    ],
)
def test_a_job_with_a_webhook_that_cannot_be_used_is_not_taken(
    http: httpx.Client, done_job: dict[str, Any], change: dict[str, Any], code: str
) -> None:
    before = http.get("/v1/jobs").json()["items"][0]["id"]
    webhook = {"url": "https://hooks.example/", "secret": SECRET, **change}
    body = {"dataset_id": done_job["dataset_id"], "webhook": webhook}
    problem(http.post("/v1/jobs", json=body), 422, code)
    assert http.get("/v1/jobs").json()["items"][0]["id"] == before
