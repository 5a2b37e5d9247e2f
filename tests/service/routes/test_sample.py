from __future__ import annotations

import io
import json
import zipfile

import httpx
import pytest

from tests.service.conftest import new_dataset, upload

pytestmark = pytest.mark.server


def test_the_sample_is_a_set_that_the_check_accepts_and_made_once(http: httpx.Client) -> None:
    answer = http.get("/v1/sample")
    assert answer.headers["content-type"] == "application/zip"
    with zipfile.ZipFile(io.BytesIO(answer.content)) as archive:
        frames = json.loads(archive.read("transforms.json"))["frames"]
    assert len(frames) == 32
    dataset = new_dataset(http)
    assert upload(http, dataset, answer.content).status_code == 200
    report = http.post(f"/v1/datasets/{dataset}/finalize").json()["report"]
    assert (report["images"], report["with_pose"]) == (32, 32)
    assert http.get("/v1/sample").content == answer.content
