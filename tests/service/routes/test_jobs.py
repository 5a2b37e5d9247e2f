from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import httpx
import pytest

from tests.service.conftest import (
    Running,
    dataset_ids,
    finished,
    problem,
    ready_dataset,
    scene_files,
    submit,
    until,
    zip_of,
)


@pytest.fixture(scope="session")
def dataset(service: Running, scene: Path) -> str:
    with httpx.Client(base_url=service.url, timeout=60.0) as client:
        return ready_dataset(client, scene)


def test_a_submitted_job_is_202_with_location_and_runs_to_its_end(http: httpx.Client, dataset: str) -> None:
    answer = http.post(
        "/v1/jobs",
        json={
            "dataset_id": dataset,
            "options": {"preset": "fast", "steps": 60, "seed": 60},
            "labels": {"run": "a"},
        },
    )
    job = answer.json()
    assert answer.status_code == 202
    assert answer.headers["location"] == f"/v1/jobs/{job['id']}" == job["links"]["self"]
    assert int(answer.headers["retry-after"]) > 0
    assert job["state"] in {"queued", "running"}
    assert job["labels"] == {"run": "a"}
    assert job["options"] == {"preset": "fast", "steps": 60, "seed": 60}
    seen = until(http, job["id"], lambda found: found["stage"] == "coarse" and found["progress"]["step"] > 0)
    assert seen["progress"]["steps_total"] == 60
    assert 0 < seen["progress"]["fraction"] < 1
    assert seen["progress"]["eta_s"] > 0
    assert seen["metrics"]["loss"] > 0
    assert seen["verdict"] is None
    assert (
        seen["resolved_options"]["max_image_size"] == 128
    )  # the preset's value, as the job's process took it
    done = finished(http, job["id"])
    assert done["verdict"] == "kept_input"  # as the report has it
    assert done["state"] == "succeeded"
    assert done["progress"]["fraction"] == 1.0
    assert done["started_at"] <= done["finished_at"]


def test_waiting_jobs_know_their_place_in_the_queue(http: httpx.Client, dataset: str) -> None:
    first = submit(http, dataset, steps=2000, step_ms=20)
    until(http, first["id"], lambda job: job["state"] == "running")
    second, third = submit(http, dataset), submit(http, dataset)
    places = [http.get(f"/v1/jobs/{job['id']}").json()["queue_position"] for job in (second, third)]
    assert places == [1, 2]
    etag = http.get(f"/v1/jobs/{third['id']}").headers["etag"]
    assert http.post(f"/v1/jobs/{second['id']}/cancel").status_code == 200  # waiting: over at once
    moved = http.get(f"/v1/jobs/{third['id']}", headers={"If-None-Match": etag})
    assert moved.status_code == 200
    assert moved.json()["queue_position"] == 1
    running = http.post(f"/v1/jobs/{first['id']}/cancel")
    assert running.status_code == 202
    assert finished(http, first["id"])["state"] == "cancelled"
    assert finished(http, third["id"])["state"] == "succeeded"
    again = http.post(f"/v1/jobs/{first['id']}/cancel")
    assert (again.status_code, again.json()["state"]) == (200, "cancelled")


def test_a_job_that_did_not_change_is_304(http: httpx.Client, done_job: dict[str, Any]) -> None:
    answer = http.get(done_job["links"]["self"])
    etag = answer.headers["etag"]
    assert etag.startswith('W/"')
    same = http.get(done_job["links"]["self"], headers={"If-None-Match": f'"x", {etag}'})
    assert (same.status_code, same.content, same.headers["etag"]) == (304, b"", etag)
    assert http.get(done_job["links"]["self"], headers={"If-None-Match": 'W/"0-0"'}).status_code == 200


def test_a_long_poll_answers_when_the_job_is_over(http: httpx.Client, dataset: str) -> None:
    job = submit(http, dataset, steps=20, step_ms=20)
    assert http.get(f"/v1/jobs/{job['id']}", params={"wait": 30}).json()["state"] == "succeeded"


def test_the_list_pages_through_all_jobs_newest_first_without_gaps(http: httpx.Client, dataset: str) -> None:
    body = {"dataset_id": dataset, "options": {"steps": 20}, "labels": {"page": "of ä five"}}
    made = [http.post("/v1/jobs", json=body).json()["id"] for _ in range(5)]
    url, seen = "/v1/jobs?limit=2&label=page%3Aof%20%C3%A4%20five", []
    for _ in range(3):
        answer = http.get(url)
        seen += [job["id"] for job in answer.json()["items"]]
        link = answer.links.get("next")
        assert (link is None) == (answer.json()["next_cursor"] is None)
        url = link["url"] if link else ""
    assert seen == made[::-1]
    assert url == ""
    for job in made:
        http.post(f"/v1/jobs/{job}/cancel")
    for job in made:
        finished(http, job)


def test_the_same_key_gives_the_same_job_and_another_request_is_refused(
    http: httpx.Client, dataset: str
) -> None:
    headers = {"Idempotency-Key": "order-17"}
    body = {"dataset_id": dataset, "options": {"steps": 20}}
    first, second = (http.post("/v1/jobs", json=body, headers=headers) for _ in range(2))
    assert first.json()["id"] == second.json()["id"]
    assert (second.status_code, second.headers["idempotent-replayed"]) == (202, "true")
    other = http.post("/v1/jobs", json={**body, "options": {"steps": 21}}, headers=headers)
    problem(other, 422, "idempotency_key_reused")
    odd = http.post("/v1/jobs", json=body, headers={"Idempotency-Key": "a b"})
    problem(odd, 400, "bad_idempotency_key")


def test_one_request_with_an_archive_is_a_whole_job(http: httpx.Client, scene: Path) -> None:
    form = {
        "files": {"archive": ("scene.zip", zip_of(scene_files(scene, "my scene/")))},
        "data": {
            "options": json.dumps({"preset": "fast", "steps": 20, "seed": 1}),
            "labels": '{"by": "form"}',
            "priority": "high",
        },
        "headers": {"Idempotency-Key": "form-1"},
    }
    before = len(http.get("/v1/datasets?limit=200").json()["items"])
    answer = http.post("/v1/jobs", **form)
    assert answer.status_code == 202, answer.text
    job = answer.json()
    assert job["labels"] == {"by": "form"}
    assert job["priority"] == "high"
    assert http.get(job["links"]["dataset"]).json()["files"] == 7
    again = http.post("/v1/jobs", **form)
    assert again.json()["id"] == job["id"]
    assert len(http.get("/v1/datasets?limit=200").json()["items"]) == before + 1
    for other in ({"labels": "{}"}, {"priority": "low"}):
        changed = {**form, "data": {**form["data"], **other}}
        problem(http.post("/v1/jobs", **changed), 422, "idempotency_key_reused")
    assert finished(http, job["id"])["state"] == "succeeded"


@pytest.mark.parametrize(
    ("form", "status", "code", "pointer"),
    [
        ({"data": {"options": "{}"}, "files": {"other": b"x"}}, 422, "invalid_request", "#/other"),
        (
            {"data": {"options": "{}", "archives": "x"}, "files": {"archive": b"x"}},
            422,
            "invalid_request",
            "#/archives",
        ),
        ({"data": {"options": "{"}, "files": {"archive": b"x"}}, 400, "malformed_json", None),
        ({"data": {"priority": "top"}, "files": {"archive": b"x"}}, 422, "invalid_request", "#/priority"),
        (
            {"data": {"options": '{"steps": 5}'}, "files": {"archive": b"x"}},
            422,
            "invalid_options",
            "#/options/steps",
        ),
        ({"data": {"options": "{}"}, "files": {"archive": b"no archive"}}, 422, "archive_rejected", None),
        ({"data": {"options": "{}"}, "files": {"archive": bytes(7 * 2**20)}}, 413, "body_too_large", None),
    ],
)
def test_a_bad_form_is_refused_and_leaves_no_dataset(
    http: httpx.Client, form: dict[str, Any], status: int, code: str, pointer: str | None
) -> None:
    before = dataset_ids(http)
    body = problem(http.post("/v1/jobs", **form), status, code)
    assert pointer is None or body["errors"][0]["pointer"] == pointer
    assert dataset_ids(http) == before


def test_a_form_that_breaks_off_is_refused(http: httpx.Client) -> None:
    content = b'--b\r\nContent-Disposition: form-data; name="archive"; filename="a"\r\n\r\nPK'
    headers = {"Content-Type": "multipart/form-data; boundary=b"}
    problem(http.post("/v1/jobs", content=content, headers=headers), 400, "malformed_body")
    headers = {"Content-Type": "multipart/form-data"}
    problem(http.post("/v1/jobs", content=content, headers=headers), 400, "malformed_body")


@pytest.mark.parametrize(
    ("options", "pointer"),
    [
        ({"stepz": 100}, "#/options/stepz"),
        ({"steps": 1}, "#/options/steps"),
        ({"preset": "best"}, "#/options/preset"),
        ({"steps": "60"}, "#/options/steps"),
        ({"fixed": [1, ["a"]]}, "#/options/fixed/0"),
        ({"coarse_steps_min": 50, "coarse_steps_max": 40}, "#/options"),
        ("fast", "#/options"),
    ],
)
def test_a_wrong_option_is_named_by_its_path(http: httpx.Client, options: object, pointer: str) -> None:
    body = problem(
        http.post("/v1/jobs", json={"dataset_id": "ds_1", "options": options}), 422, "invalid_options"
    )
    assert body["errors"][0]["pointer"] == pointer
    assert body["errors"][0]["detail"]
    assert "/v1/options" in body["hint"]


@pytest.mark.parametrize(
    ("text", "status", "code"),
    [
        ("{", 400, "malformed_json"),
        ('{"dataset_id": NaN}', 400, "malformed_json"),
        ('{"dataset_id": "a", "dataset_id": "b"}', 400, "malformed_json"),
        ("[" * 100_000, 400, "malformed_json"),
        ('{"dataset_id": "ds_1", "options": {"checkpoint_every_s": 1e999}}', 422, "invalid_options"),
        ("[]", 422, "invalid_request"),
        ('{"dataset_id": "ds_1", "extra": 1}', 422, "invalid_request"),
        ('{"dataset_id": "ds_1", "labels": {"a": "\\u0000"}}', 422, "invalid_request"),
        ('{"dataset_id": "ds_1", "x": "' + "a" * 2**20 + '"}', 413, "body_too_large"),
    ],
)
def test_a_bad_body_is_refused(http: httpx.Client, text: str, status: int, code: str) -> None:
    problem(http.post("/v1/jobs", content=text, headers={"Content-Type": "application/json"}), status, code)


def test_another_kind_of_body_is_415(http: httpx.Client) -> None:
    problem(
        http.post("/v1/jobs", content="<a/>", headers={"Content-Type": "text/xml"}), 415, "unsupported_media"
    )


def test_a_job_needs_a_dataset_that_is_there_and_ready(http: httpx.Client) -> None:
    body = {"dataset_id": "ds_00000000000000000000000000"}
    problem(http.post("/v1/jobs", json=body), 404, "not_found")
    dataset = http.post("/v1/datasets", json={}).json()["id"]
    problem(http.post("/v1/jobs", json={"dataset_id": dataset}), 409, "dataset_not_ready")


def test_a_failed_job_says_why(http: httpx.Client, dataset: str) -> None:
    job = finished(http, submit(http, dataset, threads=77)["id"])
    assert (job["state"], job["error"]["code"]) == ("failed", "diverged")
    problem(http.get(job["links"]["report"]), 404, "not_found")


def test_a_job_is_deleted_when_over_and_its_dataset_after_it(http: httpx.Client, scene: Path) -> None:
    dataset = ready_dataset(http, scene)
    job = submit(http, dataset, steps=2000, step_ms=20)
    problem(http.delete(f"/v1/jobs/{job['id']}"), 409, "state_conflict")
    problem(http.delete(f"/v1/datasets/{dataset}"), 409, "dataset_in_use")
    problem(http.get(job["links"]["report"]), 409, "result_not_ready")
    http.post(f"/v1/jobs/{job['id']}/cancel")
    finished(http, job["id"])
    assert http.delete(f"/v1/jobs/{job['id']}").status_code == 204
    problem(http.get(f"/v1/jobs/{job['id']}"), 404, "not_found")
    assert http.delete(f"/v1/datasets/{dataset}").status_code == 204
    problem(http.get(f"/v1/datasets/{dataset}"), 404, "not_found")
