from __future__ import annotations

import json
import time
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import httpx
import pytest

from tests.service.conftest import dataset_ids, problem, ready_dataset, scene_files, submit, until, zip_of

FAST = {"preset": "fast", "steps": 20, "seed": 5}


def later(seconds: float) -> str:
    return (datetime.now(UTC) + timedelta(seconds=seconds)).isoformat()


def over(job: dict[str, Any]) -> bool:
    return job["finished_at"] is not None


def test_a_job_that_waits_too_long_expires_and_its_follower_is_told(http: httpx.Client, scene: Path) -> None:
    dataset = ready_dataset(http, scene)
    running = submit(http, dataset, steps=4000, step_ms=20)["id"]
    until(http, running, lambda job: job["state"] == "running")
    body = {"dataset_id": dataset, "options": FAST, "expires_in_queue_s": 1}
    answer = http.post("/v1/jobs", json=body, headers={"Prefer": "wait=30"})
    job = answer.json()
    assert (answer.status_code, job["state"]) == (200, "expired")
    assert job["error"]["code"] == "deadline_passed"
    assert job["started_at"] is None
    told = http.get(job["links"]["events"]).text
    assert [line for line in told.splitlines() if line.startswith("event: ")] == [
        "event: queued",
        "event: progress",
        "event: expired",
    ]
    assert job["id"] in [item["id"] for item in http.get("/v1/jobs?state=expired").json()["items"]]
    assert http.get(job["links"]["artifacts"]).json()["items"] == []
    problem(http.get(job["links"]["report"]), 404, "not_found")
    problem(http.post(job["links"]["fork"], json={}), 409, "fork_not_possible")
    problem(http.post(job["links"]["exports"], json={"formats": ["kitti"]}), 409, "state_conflict")
    assert http.post(job["links"]["cancel"]).json()["state"] == "expired"
    assert http.delete(job["links"]["self"]).status_code == 204
    http.post(f"/v1/jobs/{running}/cancel")
    until(http, running, over)


@pytest.mark.parametrize("form", [False, True])
def test_a_job_is_stopped_at_its_deadline_and_keeps_what_it_has(
    http: httpx.Client, scene: Path, form: bool
) -> None:
    for seconds in (12.0, 60.0):  # a busy machine may take the whole of 12 s to begin
        job = stopped_job(http, scene, later(seconds), form)
        if job is not None and job["partial"]:
            break
    assert job is not None, "60 s did not suffice to begin it"
    assert (job["state"], job["partial"], job["error"]["code"]) == ("cancelled", True, "deadline_passed")
    assert job["finished_at"] >= job["deadline_at"]
    assert http.get(job["links"]["report"]).status_code == 200
    assert http.post(f"/v1/jobs/{job['id']}/links", json={}).status_code == 201, "it can be shown"


def stopped_job(http: httpx.Client, scene: Path, deadline: str, form: bool) -> dict[str, Any] | None:
    """A long job that is over, as the deadline has passed; None where it passed before the job was there."""
    body = {"deadline_at": deadline, "expires_in_queue_s": 600}
    options = {"preset": "fast", "steps": 4000, "seed": 20}
    if form:
        archive = {"archive": ("a.zip", zip_of(scene_files(scene)))}
        answer = http.post("/v1/jobs", files=archive, data={**body, "options": json.dumps(options)})
    else:
        body |= {"dataset_id": ready_dataset(http, scene), "options": options}
        answer = http.post("/v1/jobs", json=body)
    if answer.status_code == 422 and datetime.now(UTC) > datetime.fromisoformat(deadline):
        problem(answer, 422, "deadline_refused")
        return None
    assert answer.status_code == 202, answer.text
    asked = answer.json()
    assert datetime.fromisoformat(asked["deadline_at"]) == datetime.fromisoformat(deadline)
    assert asked["start_by"] == asked["deadline_at"], "the earlier of both"
    return until(http, asked["id"], over, 120)


def test_a_deadline_that_has_passed_is_refused_and_leaves_no_dataset(http: httpx.Client, scene: Path) -> None:
    dataset = ready_dataset(http, scene)
    before = dataset_ids(http)
    for late in (later(-1), later(31 * 86_400), "0001-01-01T00:00:00+14:00", "9999-12-31T23:59:59-14:00"):
        answer = http.post("/v1/jobs", json={"dataset_id": dataset, "deadline_at": late})
        assert problem(answer, 422, "deadline_refused")["where"] == "deadline_at"
    form = {"files": {"archive": ("a.zip", zip_of(scene_files(scene)))}, "data": {"deadline_at": later(-1)}}
    problem(http.post("/v1/jobs", **form), 422, "deadline_refused")
    assert dataset_ids(http) == before


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("expires_in_queue_s", 0),
        ("expires_in_queue_s", 31 * 86_400),
        ("expires_in_queue_s", 1.5),
        ("deadline_at", "2999-01-01T00:00:00"),
        ("deadline_at", "tomorrow"),
        ("deadline_at", round(time.time()) + 60),
        ("deadline_at", str(round(time.time()) + 60)),
    ],
    ids=["zero", "too_long", "a_fraction", "without_offset", "a_word", "a_number", "digits"],
)
def test_a_limit_that_is_none_is_named(http: httpx.Client, name: str, value: object) -> None:
    told = problem(http.post("/v1/jobs", json={"dataset_id": "ds_1", name: value}), 422, "invalid_request")
    assert told["errors"][0]["pointer"] == f"#/{name}"
