"""Two jobs compared over HTTP, against the library's result on their files."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import httpx

from biresnerf.client import Client
from biresnerf.comparison.compare_results import compare_results
from biresnerf.comparison.conclusion import Comparison
from biresnerf.data.formats.simple.poses_json import PosesDocument
from biresnerf.report import Report
from tests.service.conftest import Tenant, finished, problem, ready_dataset, submit, until


def compared(http: httpx.Client, first: str, second: str) -> httpx.Response:
    return http.get(f"/v1/jobs/{first}/comparison/{second}")


def files(http: httpx.Client, job: str) -> tuple[Report, PosesDocument]:
    report, poses = (
        http.get(f"/v1/jobs/{job}/artifacts/{name}").content for name in ("report.json", "poses.json")
    )
    return Report.model_validate_json(report), PosesDocument.model_validate_json(poses)


def test_two_jobs_are_compared_as_their_files_are(
    http: httpx.Client, scene: Path, done_job: dict[str, Any]
) -> None:
    far = finished(http, submit(http, ready_dataset(http, scene), step_ms=40)["id"])
    assert far["state"] == "succeeded"
    said = Comparison.model_validate(compared(http, done_job["id"], far["id"]).json())
    assert said == compare_results(files(http, done_job["id"]), files(http, far["id"]))
    assert (said.contradict, said.photos) == (True, 3)
    with Client(str(http.base_url)) as client:
        assert client.compare(done_job["id"], far["id"]) == said
    same = compared(http, done_job["id"], done_job["id"]).json()
    assert (same["outcome"], same["conclusion"]) == ("same", "Both results hold the same poses.")


def test_anothers_job_is_not_compared_with(tenants: tuple[Tenant, Tenant]) -> None:
    anna, bert = tenants
    problem(compared(anna.http, anna.job, bert.job), 404, "not_found")
    assert compared(anna.http, anna.job, anna.job).status_code == 200


def test_a_job_without_a_result_is_not_compared(
    http: httpx.Client, scene: Path, done_job: dict[str, Any]
) -> None:
    running = submit(http, ready_dataset(http, scene), steps=4000, step_ms=10)
    problem(compared(http, done_job["id"], running["id"]), 409, "result_not_ready")
    until(http, running["id"], lambda _: bool(http.get(running["links"]["artifacts"]).json()["items"]))
    http.post(running["links"]["cancel"], json={"keep_partial": True})
    assert finished(http, running["id"])["partial"] is True
    problem(compared(http, running["id"], done_job["id"]), 409, "state_conflict")
