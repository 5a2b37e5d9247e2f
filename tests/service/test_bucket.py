"""The whole service with its files in a bucket, as on many machines."""

from __future__ import annotations

import hashlib
import sys
from pathlib import Path

import httpx
import pytest

from biresnerf.client import Client
from tests.service.conftest import (
    PROGRAM,
    finished,
    ready_dataset,
    running_service,
    scene_files,
    short_folder,
    submit,
)
from tests.workers.buckets import by_boto, environment_of, fresh_bucket, moto_server

pytestmark = pytest.mark.server


def test_a_job_leaves_nothing_on_local_disk_and_its_files_come_from_the_bucket(
    scene: Path, tmp_path: Path
) -> None:
    with moto_server() as address, short_folder() as folder:
        bucket = fresh_bucket(address)
        said = {**environment_of(bucket), "storage_presign": True}
        with (
            running_service(folder, job_command=(sys.executable, str(PROGRAM)), **said) as service,
            httpx.Client(base_url=service.url, timeout=60.0) as http,
        ):
            job = finished(http, submit(http, ready_dataset(http, scene))["id"])
            assert job["state"] == "succeeded", job
            (artifact, *_) = [
                item
                for item in http.get(job["links"]["artifacts"]).json()["items"]
                if item["name"] == "transforms.json"
            ]
            answer = http.get(artifact["href"], headers={"Range": "bytes=1-5"})
            assert answer.status_code == 307
            assert answer.headers["location"].startswith(f"{address}/{bucket.name}/some/prefix/jobs/")
            assert answer.headers["cache-control"] == "no-store"
            there = httpx.get(answer.headers["location"])
            assert hashlib.sha256(there.content).hexdigest() == artifact["sha256"]
            assert there.headers["content-type"] == "application/json"
            here = http.get(artifact["href"], params={"redirect": "false"}, headers={"Range": "bytes=1-5"})
            assert (here.status_code, here.content) == (206, there.content[1:6])
            etag = {"If-None-Match": answer.headers["etag"]}
            assert http.get(artifact["href"], headers=etag).status_code == 304
            assert http.head(artifact["href"]).status_code == 200
            with Client(service.url) as client:
                written = client.download_all(job["id"], tmp_path / "out")
            assert tmp_path / "out/transforms.json" in written
            assert (tmp_path / "out/transforms.json").read_bytes() == there.content
            assert service.staging_is_empty()
        left = {path.relative_to(folder / "data").parts[0] for path in (folder / "data").rglob("*")}
        assert left <= {"beats", "postgres", "scratch", "slots", "staging"}
        assert [path for path in (folder / "data/scratch").rglob("*") if path.is_file()] == []
        keys = [item["Key"] for item in by_boto(bucket).list_objects_v2(Bucket=bucket.name)["Contents"]]
        of_sets = [key for key in keys if "/datasets/" in key and "/shown/" not in key]
        assert len(of_sets) == len(scene_files(scene))
        assert any("/shown/" in key for key in keys), "small photos for pages"
