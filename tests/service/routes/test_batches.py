from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import httpx
import pytest

from biresnerf.client import Client
from biresnerf.wire.batches import BATCH_MOST
from biresnerf.wire.jobs import NewJob
from tests.service.conftest import Running, finished, problem, ready_dataset

FAST = {"preset": "fast", "steps": 20, "seed": 5}
SLOW = {"preset": "fast", "steps": 4000, "seed": 20}


@pytest.fixture(scope="module")
def dataset(service: Running, scene: Path) -> str:
    with httpx.Client(base_url=service.url, timeout=60.0) as client:
        return ready_dataset(client, scene)


def newest(http: httpx.Client) -> list[str]:
    return [job["id"] for job in http.get("/v1/jobs").json()["items"]]


def test_a_batch_is_202_with_location_and_ends_when_all_its_jobs_have(
    http: httpx.Client, dataset: str
) -> None:
    names = ["hall", "stairs", "yard"]
    jobs = [{"dataset_id": dataset, "options": FAST, "labels": {"name": name}} for name in names]
    answer = http.post("/v1/batches", json={"jobs": jobs}, headers={"Idempotency-Key": "three-rooms"})
    batch = answer.json()
    assert answer.status_code == 202, answer.text
    assert answer.headers["location"] == f"/v1/batches/{batch['id']}" == batch["links"]["self"]
    assert [job["labels"]["name"] for job in batch["jobs"]] == names
    assert batch["finished_at"] is None
    assert int(http.get(batch["links"]["self"]).headers["retry-after"]) > 0
    for job in batch["jobs"]:
        assert finished(http, job["id"])["batch_id"] == batch["id"]
    over = http.get(batch["links"]["self"])
    assert over.json()["counts"] == {"succeeded": 3}
    assert {job["verdict"] for job in over.json()["jobs"]} == {"kept_input"}
    assert over.json()["finished_at"] is not None
    assert "retry-after" not in over.headers
    again = http.post("/v1/batches", json={"jobs": jobs}, headers={"Idempotency-Key": "three-rooms"})
    assert (again.json(), again.headers["idempotent-replayed"]) == (over.json(), "true")
    other = http.post("/v1/batches", json={"jobs": jobs[:2]}, headers={"Idempotency-Key": "three-rooms"})
    problem(other, 422, "idempotency_key_reused")


def test_one_bad_job_refuses_the_batch_and_is_named(http: httpx.Client, dataset: str) -> None:
    before = newest(http)
    good: dict[str, Any] = {"dataset_id": dataset, "options": FAST}
    late = {**good, "deadline_at": datetime(2026, 1, 1, tzinfo=UTC).isoformat()}
    told = problem(http.post("/v1/batches", json={"jobs": [good, late]}), 422, "deadline_refused")
    assert told["where"] == "jobs/1/deadline_at"
    wrong = {**good, "options": {"steps": 1}}
    told = problem(http.post("/v1/batches", json={"jobs": [good, wrong]}), 422, "invalid_options")
    assert told["errors"][0]["pointer"] == "#/jobs/1/options/steps"
    unknown = {**good, "dataset_id": "ds_0"}
    problem(http.post("/v1/batches", json={"jobs": [good, unknown]}), 404, "not_found")
    for jobs in ([], [good] * (BATCH_MOST + 1), good):
        told = problem(http.post("/v1/batches", json={"jobs": jobs}), 422, "invalid_request")
        assert told["errors"][0]["pointer"] == "#/jobs"
    assert newest(http) == before


def test_as_many_as_are_allowed_are_taken_at_once(http: httpx.Client, dataset: str) -> None:
    jobs = [{"dataset_id": dataset, "options": SLOW}] * BATCH_MOST
    batch = http.post("/v1/batches", json={"jobs": jobs}).json()
    assert len(batch["jobs"]) == BATCH_MOST
    asked = http.post(batch["links"]["cancel"])
    assert asked.status_code in (200, 202)
    for job in batch["jobs"]:
        finished(http, job["id"])
    over = http.post(batch["links"]["cancel"])
    assert (over.status_code, over.json()["counts"]) == (200, {"cancelled": BATCH_MOST})
    problem(http.get("/v1/batches/bat_0"), 404, "not_found")
    problem(http.post("/v1/batches/bat_0/cancel"), 404, "not_found")


def test_the_client_submits_waits_for_and_cancels_a_batch(service: Running, dataset: str) -> None:
    with Client(service.url) as client:
        batch = client.create_batch([NewJob(dataset_id=dataset, options=FAST)] * 2)
        over = client.wait_for_batch(batch.id, timeout_s=90)
        assert (over.counts, over.final) == ({"succeeded": 2}, True)
        long = client.create_batch([NewJob(dataset_id=dataset, options=SLOW)] * 2)
        assert set(client.cancel_batch(long.id, keep_partial=True).counts) <= {"running", "cancelled"}
        assert client.wait_for_batch(long.id, timeout_s=90).counts == {"cancelled": 2}
        assert client.batch(long.id).final
