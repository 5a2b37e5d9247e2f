"""Uploads over tus 1.0: by hand, and by tuspy, a client that is not ours."""

from __future__ import annotations

import base64
import hashlib
import io
import socket
import time
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import httpx
import pytest
from tusclient.client import TusClient
from tusclient.exceptions import TusCommunicationError

from tests.service.conftest import MIB, Running, new_dataset, problem, scene_files, zip_of

TUS = {"Tus-Resumable": "1.0.0"}
PATCH = {**TUS, "Content-Type": "application/offset+octet-stream"}
NOISE = bytes(range(256)) * 6000  # 1.5 MB


def metadata(**values: str) -> dict[str, str]:
    pairs = ",".join(f"{name} {base64.b64encode(value.encode()).decode()}" for name, value in values.items())
    return {"Upload-Metadata": pairs}


def begin(http: httpx.Client, dataset: str, size: int, **said: str) -> str:
    answer = http.post(
        f"/v1/datasets/{dataset}/uploads", headers={**TUS, "Upload-Length": str(size), **metadata(**said)}
    )
    assert answer.status_code == 201, answer.text
    assert answer.headers["tus-resumable"] == "1.0.0"
    assert answer.headers["location"] == f"/v1/uploads/{answer.json()['id']}"
    return str(answer.headers["location"])


def offset(http: httpx.Client, upload: str) -> int:
    answer = http.head(upload, headers=TUS)
    assert (answer.status_code, answer.headers["cache-control"]) == (200, "no-store")
    return int(answer.headers["upload-offset"])


def send(http: httpx.Client, upload: str, start: int, content: bytes) -> httpx.Response:
    return http.patch(upload, headers={**PATCH, "Upload-Offset": str(start)}, content=content)


def settled(http: httpx.Client, upload: str) -> dict[str, Any]:
    end = time.monotonic() + 30
    while True:
        found: dict[str, Any] = http.get(upload).json()
        if found["state"] in {"stored", "rejected"}:
            return found
        assert time.monotonic() < end, found
        time.sleep(0.05)


def digests(http: httpx.Client, dataset: str) -> dict[str, str]:
    return {
        item["path"]: item["sha256"] for item in http.get(f"/v1/datasets/{dataset}/files").json()["items"]
    }


def expected(files: dict[str, bytes]) -> dict[str, str]:
    return {name: hashlib.sha256(content).hexdigest() for name, content in files.items()}


def test_an_archive_in_pieces_becomes_a_dataset(http: httpx.Client, scene: Path) -> None:
    files = scene_files(scene)
    archive = zip_of(files)
    dataset = new_dataset(http)
    upload = begin(http, dataset, len(archive), sha256=hashlib.sha256(archive).hexdigest())
    for start in range(0, len(archive), 5000):
        assert offset(http, upload) == start
        answer = send(http, upload, start, archive[start : start + 5000])
        assert (answer.status_code, answer.headers["tus-resumable"]) == (204, "1.0.0")
        assert int(answer.headers["upload-offset"]) == min(start + 5000, len(archive))
    assert http.post(f"/v1/datasets/{dataset}/finalize").json()["state"] == "ready"
    assert settled(http, upload)["state"] == "stored"
    assert digests(http, dataset) == expected(files)


def test_what_arrived_before_the_connection_broke_is_kept(service: Running, http: httpx.Client) -> None:
    dataset = new_dataset(http)
    upload = begin(http, dataset, len(NOISE), path="images/big.bin")
    at = urlsplit(service.url)
    with socket.create_connection((at.hostname, at.port)) as wire:
        head = f"PATCH {upload} HTTP/1.1\r\nHost: {at.netloc}\r\nTus-Resumable: 1.0.0\r\nUpload-Offset: 0\r\n"
        head += f"Content-Type: application/offset+octet-stream\r\nContent-Length: {len(NOISE)}\r\n\r\n"
        wire.sendall(head.encode() + NOISE[:600_000])
    end = time.monotonic() + 20
    while (kept := offset(http, upload)) == 0:
        assert time.monotonic() < end
        time.sleep(0.05)
    assert kept <= 600_000
    assert send(http, upload, kept, NOISE[kept:]).status_code == 204
    assert settled(http, upload)["state"] == "stored"
    assert digests(http, dataset) == expected({"images/big.bin": NOISE})


def test_an_independent_client_sends_and_resumes(service: Running, http: httpx.Client) -> None:
    dataset = new_dataset(http)
    client = TusClient(f"{service.url}/v1/datasets/{dataset}/uploads")
    first = client.uploader(
        file_stream=io.BytesIO(NOISE), chunk_size=400_000, metadata={"path": "a/ü.bin", "filename": "x"}
    )
    first.upload_chunk()
    assert first.url is not None
    again = client.uploader(file_stream=io.BytesIO(NOISE), chunk_size=500_000, url=first.url)
    assert again.offset == 400_000
    again.upload()
    assert settled(http, urlsplit(first.url).path)["state"] == "stored"
    assert digests(http, dataset) == expected({"a/ü.bin": NOISE})
    options = httpx.options(client.url, headers=TUS)
    assert options.headers["tus-version"] == "1.0.0"
    assert int(options.headers["tus-max-size"]) == 6 * MIB
    http.delete(again.url, headers=TUS)
    with pytest.raises(TusCommunicationError):
        client.uploader(file_stream=io.BytesIO(NOISE), url=again.url).upload()


def test_only_the_next_byte_is_taken(http: httpx.Client) -> None:
    upload = begin(http, new_dataset(http), 10, path="a")
    assert send(http, upload, 0, b"01234").status_code == 204
    for start in (0, 4, 6, 9):
        problem(send(http, upload, start, b"5"), 409, "offset_mismatch")
    problem(send(http, upload, 5, b"567890"), 413, "body_too_large")
    assert offset(http, upload) == 5
    assert send(http, upload, 5, b"56789").status_code == 204
    assert send(http, upload, 10, b"").status_code == 204


def test_a_rejected_upload_is_told_at_the_end_and_can_be_given_up(http: httpx.Client) -> None:
    dataset = new_dataset(http)
    http.put(f"/v1/datasets/{dataset}/files/a.txt", content=b"x")
    upload = begin(http, dataset, 4)
    send(http, upload, 0, b"what")
    found = settled(http, upload)
    assert (found["state"], found["error"]["code"]) == ("rejected", "archive_rejected")
    told = problem(http.post(f"/v1/datasets/{dataset}/finalize"), 422, "archive_rejected")
    assert f"DELETE {upload}" in told["hint"]
    wrong = begin(http, dataset, 1, path="b", sha256="0" * 64)
    send(http, wrong, 0, b"b")
    assert settled(http, wrong)["error"]["code"] == "digest_mismatch"
    half = begin(http, dataset, 5, path="c")
    for address in (upload, wrong):
        assert http.delete(address, headers=TUS).status_code == 204
        problem(http.get(address), 404, "not_found")
    problem(http.post(f"/v1/datasets/{dataset}/finalize"), 409, "dataset_not_complete")
    assert http.delete(half, headers=TUS).status_code == 204
    assert digests(http, dataset) == expected({"a.txt": b"x"})


def test_an_empty_file_needs_no_bytes(http: httpx.Client) -> None:
    dataset = new_dataset(http)
    assert settled(http, begin(http, dataset, 0, path="empty"))["state"] == "stored"
    assert digests(http, dataset) == expected({"empty": b""})


@pytest.mark.parametrize(
    ("headers", "status", "code"),
    [
        ({"Upload-Length": "5"}, 412, "precondition_failed"),
        ({"Upload-Length": "5", "Tus-Resumable": "0.2.2"}, 412, "precondition_failed"),
        (TUS, 422, "invalid_request"),
        ({**TUS, "Upload-Length": "-1"}, 422, "invalid_request"),
        ({**TUS, "Upload-Length": "many"}, 422, "invalid_request"),
        ({**TUS, "Upload-Length": "9" * 30}, 422, "invalid_request"),
        ({**TUS, "Upload-Length": str(7 * MIB)}, 413, "body_too_large"),
        ({**TUS, "Upload-Length": "5", "Upload-Metadata": "path ?"}, 422, "invalid_request"),
        ({**TUS, "Upload-Length": "5", **metadata(path="../a")}, 422, "unsafe_path"),
        ({**TUS, "Upload-Length": "5", **metadata(sha256="short")}, 422, "invalid_request"),
    ],
)
def test_a_bad_beginning_is_a_problem(
    http: httpx.Client, headers: dict[str, str], status: int, code: str
) -> None:
    address = f"/v1/datasets/{new_dataset(http)}/uploads"
    answer = http.post(address, headers=headers)
    problem(answer, status, code)
    assert answer.headers["tus-resumable"] == "1.0.0"
    problem(http.post("/v1/datasets/ds_0/uploads", headers={**TUS, "Upload-Length": "5"}), 404, "not_found")


def test_a_bad_continuation_is_a_problem(http: httpx.Client) -> None:
    upload = begin(http, new_dataset(http), 5, path="a")
    problem(http.patch(upload, headers={**PATCH}, content=b"x"), 422, "invalid_request")
    headers = {**TUS, "Upload-Offset": "0", "Content-Type": "application/octet-stream"}
    problem(http.patch(upload, headers=headers, content=b"x"), 415, "unsupported_media")
    problem(http.patch(upload, headers={"Upload-Offset": "0"}, content=b"x"), 412, "precondition_failed")
    for method in ("HEAD", "DELETE"):
        assert http.request(method, upload).status_code == 412
    problem(send(http, "/v1/uploads/up_0", 0, b"x"), 404, "not_found")
    assert offset(http, upload) == 0
