from __future__ import annotations

import base64
import hashlib
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import httpx
import psycopg
import pytest

from tests.service.conftest import Running, finished, problem, ready_dataset, submit, until
from workers.database.embedded_postgres import EmbeddedPostgres

CONTENT = bytes(range(256)) * 40


@pytest.fixture
def video(done_job: dict[str, Any]) -> str:
    return f"{done_job['links']['artifacts']}/renders/orbit.mp4"


def test_the_list_names_every_file_with_its_digest(http: httpx.Client, done_job: dict[str, Any]) -> None:
    items = http.get(done_job["links"]["artifacts"]).json()["items"]
    names = {item["name"] for item in items}
    assert {"transforms.json", "report.json", "renders/orbit.mp4", "colmap/sparse/0/cameras.bin"} <= names
    for item in items:
        content = http.get(item["href"]).content
        assert (len(content), hashlib.sha256(content).hexdigest()) == (item["size"], item["sha256"])


def test_a_download_is_an_attachment_with_a_strong_tag(http: httpx.Client, video: str) -> None:
    answer = http.get(video)
    digest = hashlib.sha256(CONTENT)
    assert (answer.status_code, answer.content) == (200, CONTENT)
    assert answer.headers["etag"] == f'"{digest.hexdigest()}"'
    assert answer.headers["repr-digest"] == f"sha-256=:{base64.b64encode(digest.digest()).decode()}:"
    assert answer.headers["accept-ranges"] == "bytes"
    assert answer.headers["content-length"] == str(len(CONTENT))
    assert answer.headers["content-type"] == "video/mp4"
    assert answer.headers["content-disposition"].startswith('attachment; filename="orbit.mp4"')
    assert answer.headers["x-content-type-options"] == "nosniff"


def test_head_says_the_same_without_the_bytes(http: httpx.Client, video: str) -> None:
    whole, head = http.get(video), http.head(video)
    for name in ("etag", "content-length", "content-type", "content-disposition", "accept-ranges"):
        assert head.headers[name] == whole.headers[name]
    assert (head.status_code, head.content) == (200, b"")


def test_a_known_file_is_304(http: httpx.Client, video: str) -> None:
    etag = http.head(video).headers["etag"]
    answer = http.get(video, headers={"If-None-Match": etag})
    assert (answer.status_code, answer.content, answer.headers["etag"]) == (304, b"", etag)
    assert http.get(video, headers={"If-None-Match": '"other"'}).status_code == 200


@pytest.mark.parametrize(
    ("spec", "first", "last"),
    [("0-0", 0, 0), ("100-299", 100, 299), ("10000-", 10000, 10239), ("-5", 10235, 10239)],
)
def test_a_range_is_206_with_just_these_bytes(
    http: httpx.Client, video: str, spec: str, first: int, last: int
) -> None:
    answer = http.get(video, headers={"Range": f"bytes={spec}"})
    assert (answer.status_code, answer.content) == (206, CONTENT[first : last + 1])
    assert answer.headers["content-range"] == f"bytes {first}-{last}/10240"
    assert answer.headers["content-length"] == str(last - first + 1)


def test_a_range_beyond_the_end_is_416_and_nonsense_is_400(http: httpx.Client, video: str) -> None:
    answer = http.get(video, headers={"Range": "bytes=10240-"})
    problem(answer, 416, "range_not_satisfiable")
    assert answer.headers["content-range"] == "bytes */10240"
    problem(http.get(video, headers={"Range": "bytes=5-2"}), 400, "bad_range")
    problem(http.get(video, headers={"Range": "bytes=a-b"}), 400, "bad_range")
    problem(http.get(video, headers={"Range": f"bytes={'9' * 5000}-"}), 400, "bad_range")


def test_a_download_is_resumed_only_if_the_file_is_the_same(http: httpx.Client, video: str) -> None:
    etag = http.head(video).headers["etag"]
    same = http.get(video, headers={"Range": "bytes=9000-", "If-Range": etag})
    assert (same.status_code, same.content) == (206, CONTENT[9000:])
    changed = http.get(video, headers={"Range": "bytes=9000-", "If-Range": '"old"'})
    assert (changed.status_code, changed.content) == (200, CONTENT)


def test_a_name_beyond_ascii_comes_through(http: httpx.Client, done_job: dict[str, Any]) -> None:
    (item,) = [i for i in http.get(done_job["links"]["artifacts"]).json()["items"] if "Blick" in i["name"]]
    disposition = http.get(item["href"]).headers["content-disposition"]
    assert unquote(disposition.split("filename*=UTF-8''")[1]) == "Blick über «Dach».png"


def test_the_report_is_the_artifact(http: httpx.Client, done_job: dict[str, Any]) -> None:
    answer = http.get(done_job["links"]["report"])
    assert answer.headers["content-type"] == "application/json"
    assert answer.content == http.get(f"{done_job['links']['artifacts']}/report.json").content
    assert answer.json()["state"] == "complete"


@pytest.mark.parametrize("name", ["nothing.png", "..%2f..%2freport.json", "%00", "report.json/", "renders"])
def test_other_names_are_404(http: httpx.Client, done_job: dict[str, Any], name: str) -> None:
    problem(http.get(f"{done_job['links']['artifacts']}/{name}"), 404, "not_found")


def test_a_result_whose_time_is_over_is_410_while_its_record_stays(
    service: Running, http: httpx.Client, scene: Path
) -> None:
    job = finished(http, submit(http, ready_dataset(http, scene))["id"])
    here = job["links"]["self"]
    until(http, job["id"], lambda found: found["expires_at"] is not None)
    with psycopg.connect(EmbeddedPostgres(service.data_dir / "postgres").url) as connection:
        connection.execute(
            "UPDATE jobs SET finished_at = now() - interval '8 days', expires_at = NULL WHERE id = %s",
            (job["id"],),
        )
    until(http, job["id"], lambda found: found["state"] == "expired")
    for path in ("/artifacts", "/artifacts/report.json", "/report"):
        problem(http.get(here + path), 410, "expired")
    assert http.head(here + "/artifacts/report.json").status_code == 410
    events = http.get(here + "/events").text
    assert "event: succeeded" in events
    assert "event: files_expired" in events
    folder = service.data_dir / "files" / "jobs" / job["id"]
    until(http, job["id"], lambda _: not folder.exists())
    until(http, job["id"], lambda _: f"deleted jobs/{job['id']}: " in service.log.read_text())
    assert http.get("/v1/jobs?state=expired").json()["items"][0]["id"] == job["id"]
    assert http.delete(here).status_code == 204
