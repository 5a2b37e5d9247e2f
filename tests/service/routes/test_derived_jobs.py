"""What a job offers beside its state: log, previews, partial result, rows, exports, forks, waiting."""

from __future__ import annotations

import json
import time
from pathlib import Path
from typing import Any

import httpx
import pytest

from tests.service.conftest import Running, finished, problem, ready_dataset, submit, until


@pytest.fixture(scope="module")
def dataset(service: Running, scene: Path) -> str:
    with httpx.Client(base_url=service.url, timeout=60.0) as client:
        return ready_dataset(client, scene)


def listed(http: httpx.Client, job: dict[str, Any]) -> dict[str, dict[str, Any]]:
    return {item["name"]: item for item in http.get(job["links"]["artifacts"]).json()["items"]}


def test_a_running_job_shows_a_preview_and_a_cancelled_one_keeps_what_was_asked_for(
    http: httpx.Client, dataset: str
) -> None:
    job = submit(http, dataset, steps=4000, step_ms=10)
    until(http, job["id"], lambda _: bool(listed(http, job)))
    (shown,) = listed(http, job).values()
    assert (shown["name"], shown["preview"]) == ("preview/poses.json", True)
    answer = http.get(shown["href"])
    assert answer.json()["step"] >= 20
    assert answer.headers["cache-control"] == "no-cache"
    answer = http.get(job["links"]["report"])
    problem(answer, 409, "result_not_ready")
    assert answer.headers["retry-after"]
    problem(http.post(job["links"]["cancel"], json={"keep": True}), 422, "invalid_request")
    assert http.post(job["links"]["cancel"], json={"keep_partial": True}).status_code == 202
    over = finished(http, job["id"])
    assert (over["state"], over["partial"]) == ("cancelled", True)
    left = listed(http, job)
    assert set(left) == {"log.txt", "poses.json", "report.json"}
    assert not any(item["preview"] for item in left.values())
    assert http.get(job["links"]["report"]).json()["state"] == "partial"
    assert http.get(job["links"]["images"]).json() == {"partial": True, "items": []}


def test_the_log_is_read_in_pages_as_text_and_as_objects(
    http: httpx.Client, done_job: dict[str, Any]
) -> None:
    url = done_job["links"]["logs"]
    whole = http.get(url)
    assert whole.headers["content-type"].startswith("text/plain")
    assert whole.text == "images read\nline 2\n"
    assert "next" not in whole.links, "the job is over"
    first = http.get(url, params={"limit": 1}, headers={"Accept": "application/x-ndjson"})
    (line,) = map(json.loads, first.text.splitlines())
    assert (line["n"], line["attempt"], line["text"]) == (1, 1, "images read")
    assert http.get(first.links["next"]["url"]).text == "line 2\n"
    assert http.get(url, params={"format": "ndjson", "after": 2}).text == ""


def test_the_log_of_a_running_job_goes_on(http: httpx.Client, dataset: str) -> None:
    job = submit(http, dataset, steps=4000, step_ms=10)
    until(http, job["id"], lambda _: http.get(job["links"]["logs"]).text != "")
    answer = http.get(job["links"]["logs"])
    assert answer.headers["retry-after"]
    assert answer.links["next"]["url"].startswith(f"{job['links']['logs']}?after=2")
    http.post(job["links"]["cancel"])
    assert finished(http, job["id"])["partial"] is False
    assert set(listed(http, job)) == {"log.txt"}


@pytest.mark.parametrize(
    ("sort", "names"),
    [("", "abc"), ("moved_deg", "acb"), ("-moved_deg", "bca"), ("delta_psnr", "bca"), ("-delta_psnr", "cba")],
)
def test_images_are_sorted_by_any_column_and_unknown_values_come_last(
    http: httpx.Client, done_job: dict[str, Any], sort: str, names: str
) -> None:
    items = http.get(done_job["links"]["images"], params={"sort": sort}).json()["items"]
    assert [item["name"] for item in items] == list(names)
    assert {item["name"]: item["delta_psnr"] for item in items} == {"a": None, "b": 1.0, "c": 4.0}


def test_an_unknown_column_is_named(http: httpx.Client, done_job: dict[str, Any]) -> None:
    body = problem(http.get(done_job["links"]["images"], params={"sort": "-beauty"}), 422, "invalid_request")
    assert body["errors"][0]["pointer"] == "/query/sort"
    assert "moved_deg" in body["detail"]


def test_an_export_is_a_job_whose_files_stand_among_the_result(
    http: httpx.Client, done_job: dict[str, Any]
) -> None:
    answer = http.post(done_job["links"]["exports"], json={"formats": ["kitti"]})
    assert answer.status_code == 202
    export = answer.json()
    assert (export["kind"], export["parent"]) == ("export", done_job["id"])
    assert answer.headers["location"] == f"/v1/jobs/{export['id']}"
    assert finished(http, export["id"])["state"] == "succeeded"
    file = listed(http, done_job)["kitti.txt"]
    assert http.get(file["href"]).text == "exported"
    again = http.post(done_job["links"]["exports"], json={"formats": ["kitti"]})
    assert (again.status_code, again.json()["id"]) == (200, export["id"])
    assert again.headers["idempotent-replayed"] == "true"
    other = http.post(done_job["links"]["exports"], json={"formats": ["bundler", "kitti"]}).json()
    assert other["id"] != export["id"]
    finished(http, other["id"])
    known = [item["id"] for item in http.get(done_job["links"]["exports"]).json()["items"]]
    assert known == [export["id"], other["id"]]
    everything = {item["id"] for item in http.get("/v1/jobs", params={"limit": 200}).json()["items"]}
    assert done_job["id"] in everything
    assert not everything & set(known), "exports are listed with their job"
    problem(http.post(done_job["links"]["exports"], json={"formats": ["obj"]}), 422, "invalid_request")
    problem(http.post(done_job["links"]["exports"], json={"formats": []}), 422, "invalid_request")
    problem(http.post(export["links"]["exports"], json={"formats": ["kitti"]}), 409, "state_conflict")
    of_body = {"formats": ["kitti"], "poses_of": "body"}
    body = http.post(done_job["links"]["exports"], json=of_body).json()
    assert body["id"] != export["id"], "another export than that of the cameras"
    assert body["options"] == of_body
    finished(http, body["id"])
    seen = http.post(done_job["links"]["exports"], json={"formats": ["pinhole"], "poses_of": "body"})
    assert "pinhole would show what cameras see" in str(problem(seen, 422, "invalid_request"))


def test_an_export_is_done_while_refinements_hold_and_wait_for_the_only_slot(
    http: httpx.Client, dataset: str
) -> None:
    done = finished(http, submit(http, dataset)["id"])
    long = submit(http, dataset, steps=4000, step_ms=50)
    while http.get(long["links"]["self"]).json()["state"] != "running":
        time.sleep(0.1)
    waiting = submit(http, dataset)
    export = http.post(done["links"]["exports"], json={"formats": ["kitti"]}).json()
    assert export["queue_position"] == 1, "a place among exports"
    assert finished(http, export["id"])["state"] == "succeeded"
    states = [http.get(job["links"]["self"]).json()["state"] for job in (long, waiting)]
    assert states == ["running", "queued"]
    for job in (waiting, long):
        http.post(job["links"]["cancel"])
        finished(http, job["id"])


def test_only_a_result_is_exported_and_exports_are_deleted_with_it(http: httpx.Client, dataset: str) -> None:
    job = submit(http, dataset, steps=4000, step_ms=10)
    answer = http.post(job["links"]["exports"], json={"formats": ["kitti"]})
    problem(answer, 409, "result_not_ready")
    http.post(job["links"]["cancel"])
    finished(http, job["id"])
    problem(http.post(job["links"]["exports"], json={"formats": ["kitti"]}), 409, "state_conflict")
    done = finished(http, submit(http, dataset)["id"])
    export = http.post(done["links"]["exports"], json={"formats": ["kitti"]}).json()
    finished(http, export["id"])
    assert http.delete(done["links"]["self"]).status_code == 204
    problem(http.get(export["links"]["self"]), 404, "not_found")


def test_a_fork_is_refused_with_the_reason(http: httpx.Client, done_job: dict[str, Any]) -> None:
    body = problem(http.post(done_job["links"]["fork"], json={}), 409, "fork_not_possible")
    assert "stage 1" in body["detail"]
    assert "COLMAP" in body["detail"]
    wrong = {"options": {"steps": 1}}
    problem(http.post(done_job["links"]["fork"], json=wrong), 422, "invalid_options")
    problem(http.post(done_job["links"]["fork"], json={"from_stage": "fine"}), 422, "invalid_request")


def test_a_client_that_prefers_to_wait_gets_the_job_when_it_is_over(http: httpx.Client, dataset: str) -> None:
    body = {"dataset_id": dataset, "options": {"preset": "fast", "steps": 20, "seed": 1}}
    answer = http.post("/v1/jobs", json=body, headers={"Prefer": "respond-async, wait=30"})
    assert (answer.status_code, answer.json()["state"]) == (200, "succeeded")
    assert answer.headers["preference-applied"] == "wait=30"
    body["options"] = {"preset": "fast", "steps": 4000, "seed": 10}
    answer = http.post("/v1/jobs", json=body, headers={"Prefer": "wait=1"})
    assert (answer.status_code, answer.json()["state"]) == (202, "running")
    assert answer.headers["retry-after"]
    http.post(answer.json()["links"]["cancel"])
    finished(http, answer.json()["id"])


def test_jobs_are_listed_from_a_time_on(http: httpx.Client, done_job: dict[str, Any]) -> None:
    def ids(moment: str) -> set[str]:
        items = http.get("/v1/jobs", params={"created_after": moment, "limit": 200}).json()["items"]
        return {item["id"] for item in items}

    assert done_job["id"] not in ids(done_job["created_at"])
    assert done_job["id"] in ids("2020-01-31T12:00:00Z")
    problem(http.get("/v1/jobs", params={"created_after": "2020-01-31T12:00:00"}), 422, "invalid_request")


def test_a_job_joins_a_finished_result_which_stays_as_long_as_it_is_needed(
    http: httpx.Client, dataset: str
) -> None:
    def joined(to: str) -> httpx.Response:
        body = {"dataset_id": dataset, "fixed_from": to, "options": {"steps": 4000, "seed": 10}}
        return http.post("/v1/jobs", json=body)

    base = submit(http, dataset, steps=60, step_ms=10)
    problem(joined(base["id"]), 409, "result_not_ready")
    problem(joined("job_nothing"), 404, "not_found")
    finished(http, base["id"])
    job = joined(base["id"]).json()
    assert (job["fixed_from"], job["forked_from"]) == (base["id"], None)
    answer = problem(http.delete(f"/v1/jobs/{base['id']}"), 409, "state_conflict")
    assert job["id"] in answer["detail"]
    http.post(job["links"]["cancel"])
    finished(http, job["id"])
    assert http.delete(f"/v1/jobs/{base['id']}").status_code == 204
    problem(joined(base["id"]), 404, "not_found")


def test_the_parts_of_a_split_job_are_listed_with_it_alone(http: httpx.Client, scene: Path) -> None:
    dataset = ready_dataset(http, scene)
    body = {"dataset_id": dataset, "options": {"preset": "fast", "steps": 20, "seed": 1}, "part_photos": 20}
    answer = http.post("/v1/jobs", json=body)
    assert answer.status_code == 202
    whole = finished(http, answer.json()["id"])
    assert (whole["state"], whole["parts"]) == ("succeeded", {"parts": 3, "over": 3, "failed": 0})
    parts = http.get(whole["links"]["parts"]).json()["items"]
    assert [part["options"]["photos"] for part in parts] == [["a"], ["b"], ["c"]]
    assert {(part["state"], part["parent"], part["parts"]) for part in parts} == {
        ("succeeded", whole["id"], None)
    }
    listed_jobs = {
        item["id"]: item["parts"] for item in http.get("/v1/jobs", params={"limit": 200}).json()["items"]
    }
    assert listed_jobs[whole["id"]] == whole["parts"]
    assert not set(listed_jobs) & {part["id"] for part in parts}
    assert http.get(whole["links"]["exports"]).json()["items"] == []
    problem(http.post("/v1/jobs", json={**body, "part_photos": 5}), 422, "invalid_request")


def test_most_jobs_have_no_parts(http: httpx.Client, done_job: dict[str, Any]) -> None:
    assert done_job["parts"] is None
    assert http.get(done_job["links"]["parts"]).json()["items"] == []
