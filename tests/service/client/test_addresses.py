"""Sets in a bucket, whose addresses the caller signs and the service fetches; moto stands for the caller's S3."""

from __future__ import annotations

import io
import os
import subprocess
import sys
import zipfile
from collections.abc import Iterator
from pathlib import Path
from urllib.parse import parse_qs, urlsplit

import httpx
import pytest

from biresnerf.client import Client, FileAddress, ServiceError, bucket_files, bucket_target
from biresnerf.errors import InputError
from tests.service.conftest import Running, dataset_ids, problem, scene_files, until, zip_of
from tests.workers.buckets import by_boto, fresh_bucket, moto_server
from workers.store.file_places import Bucket

pytestmark = pytest.mark.server
FAST = {"preset": "fast", "steps": 20, "seed": 5}
FAST_SET = ("--preset", "fast", "--set", "steps=20", "--set", "seed=5")
COMMAND = (sys.executable, "-m", "biresnerf.command_line", "submit")


@pytest.fixture
def bucket(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[Bucket]:
    """An own bucket, with credentials that only this machine has."""
    with moto_server() as address:
        made = fresh_bucket(address)
        for name, value in {
            "AWS_ENDPOINT_URL_S3": address,
            "AWS_ACCESS_KEY_ID": "CALLERSKEY",
            "AWS_SECRET_ACCESS_KEY": "CALLERSSECRET",
            "AWS_CONFIG_FILE": str(tmp_path / "none"),
            "AWS_SHARED_CREDENTIALS_FILE": str(tmp_path / "none"),
        }.items():
            monkeypatch.setenv(name, value)
        yield made


def put(bucket: Bucket, files: dict[str, bytes]) -> None:
    for key, content in files.items():
        by_boto(bucket).put_object(Bucket=bucket.name, Key=key, Body=content)


def test_a_folder_of_a_bucket_becomes_addresses_of_its_files_alone(bucket: Bucket) -> None:
    put(
        bucket,
        {"set/a.jpg": b"abc", "set/in/b c+é.jpg": b"de", "set/": b"", "set/.DS_Store": b"x", "set2/c": b"f"},
    )
    found = bucket_files(f"s3://{bucket.name}/set", valid_s=77)
    assert {(file.path, file.size) for file in found} == {("a.jpg", 3), ("in/b c+é.jpg", 2)}
    for file, content in zip(sorted(found, key=lambda file: file.path), (b"abc", b"de"), strict=True):
        assert httpx.get(file.url).content == content
        asked = parse_qs(urlsplit(file.url).query)
        assert (asked["X-Amz-Expires"], asked["X-Amz-Algorithm"]) == (["77"], ["AWS4-HMAC-SHA256"])
        assert "X-Amz" not in repr(file)
    assert [file.path for file in bucket_files(f"s3://{bucket.name}/set/in/")] == ["b c+é.jpg"]
    (archive,) = bucket_files(f"s3://{bucket.name}/set/a.jpg")
    assert (archive.path, archive.size) == (None, 3)


@pytest.mark.parametrize("place", ["s3://no-such-bucket/set", "s3://{}/none"], ids=["no bucket", "no file"])
def test_a_bucket_that_cannot_be_read_is_said_before_anything_is_sent(bucket: Bucket, place: str) -> None:
    with pytest.raises(InputError) as told:
        bucket_files(place.format(bucket.name))
    assert told.value.code == "bucket_unreadable"


@pytest.mark.parametrize("packed", [False, True], ids=["folder", "archive"])
def test_the_command_submits_what_lies_in_a_bucket_and_the_service_learns_no_secret(
    http: httpx.Client, service: Running, scene: Path, bucket: Bucket, packed: bool
) -> None:
    files = scene_files(scene)
    put(
        bucket,
        {"photos/set.zip": zip_of(files)} if packed else {f"photos/{name}": c for name, c in files.items()},
    )
    command = [
        sys.executable,
        "-m",
        "biresnerf.command_line",
        "submit",
        "--preset",
        "fast",
        "--set",
        "steps=20",
    ]
    place = f"s3://{bucket.name}/photos" + ("/set.zip" if packed else "")
    done = subprocess.run(
        [*command, place, "--set", "seed=5", "--wait"],
        env={**os.environ, "BIRESNERF_URL": service.url},
        capture_output=True,
        text=True,
        timeout=90,
    )
    assert done.returncode == 0, done.stderr
    job = http.get(f"/v1/jobs/{done.stdout.split()[0].rpartition('/')[2]}").json()
    assert (job["state"], job["labels"]["name"]) == ("succeeded", "set.zip" if packed else "photos")
    stored = http.get(f"/v1/datasets/{job['dataset_id']}/files").json()["items"]
    assert {item["path"] for item in stored} == set(files)
    log = service.log.read_text()
    assert "CALLERSSECRET" not in log
    assert "X-Amz-Signature" not in log


def test_an_address_that_leads_to_nothing_fails_by_name_and_leaves_no_dataset(
    http: httpx.Client, service: Running, bucket: Bucket
) -> None:
    put(bucket, {"a.jpg": b"abc"})
    before = dataset_ids(http)
    (good,) = bucket_files(f"s3://{bucket.name}")
    bad = FileAddress(url=good.url.replace("a.jpg", "gone.jpg"), path="gone.jpg")
    with Client(service.url) as client, pytest.raises(ServiceError) as told:
        client.submit([good, bad], FAST)
    assert (told.value.code, told.value.where) == ("fetch_failed", "gone.jpg")
    assert dataset_ids(http) == before


def test_the_command_has_the_result_sent_into_the_callers_bucket(
    http: httpx.Client, service: Running, scene: Path, bucket: Bucket
) -> None:
    done = subprocess.run(
        [*COMMAND, str(scene), *FAST_SET, "--deliver", f"s3://{bucket.name}/results/"],
        env={**os.environ, "BIRESNERF_URL": service.url},
        capture_output=True,
        text=True,
        timeout=90,
    )
    assert done.returncode == 0, done.stderr
    job = done.stdout.split()[0].rpartition("/")[2]
    found = until(http, job, lambda now: now["delivered"][0]["state"] != "waiting")
    assert (found["state"], found["delivered"][0]["error"]) == ("succeeded", None)
    sent = by_boto(bucket).get_object(Bucket=bucket.name, Key="results/result.zip")
    assert sent["ContentType"] == "application/zip"
    with zipfile.ZipFile(io.BytesIO(sent["Body"].read())) as archive:
        items = {item["name"]: item for item in http.get(f"/v1/jobs/{job}/artifacts").json()["items"]}
        assert {name: len(archive.read(name)) for name in archive.namelist()} == {
            name: item["size"] for name, item in items.items()
        }
    assert "X-Amz-Signature" not in http.get(f"/v1/jobs/{job}").text + service.log.read_text()
    link = http.post(f"/v1/jobs/{job}/links", json={}).json()["token"]
    seen = http.get(f"/v1/jobs/{job}", headers={"Authorization": f"Bearer {link}"}).json()
    assert seen["delivered"] == []
    ((_, target),) = bucket_target(f"s3://{bucket.name}/again.zip", valid_s=60).addresses
    again = http.post(f"/v1/jobs/{job}/deliver", json={"files": {"report.json": target}})
    assert (again.status_code, len(again.json()["delivered"])) == (202, 2)
    until(http, job, lambda now: {item["state"] for item in now["delivered"]} == {"delivered"})
    refused = http.post(f"/v1/jobs/{job}/deliver", json={"archive": "http://169.254.169.254/?SECRET"})
    assert "SECRET" not in problem(refused, 422, "address_refused")["detail"]
    problem(http.post(f"/v1/jobs/{job}/deliver", json={}), 422, "invalid_request")


def test_of_several_sets_from_here_and_a_bucket_each_result_has_a_folder_of_its_own_there(
    http: httpx.Client, service: Running, scene: Path, bucket: Bucket
) -> None:
    put(bucket, {f"far/{name}": content for name, content in scene_files(scene).items()})
    there = f"s3://{bucket.name}"
    done = subprocess.run(
        [*COMMAND, str(scene), f"{there}/far", *FAST_SET, "--deliver", f"{there}/results"],
        env={**os.environ, "BIRESNERF_URL": service.url},
        capture_output=True,
        text=True,
        timeout=90,
    )
    assert done.returncode == 0, done.stderr
    for line in done.stdout.splitlines():
        job = line.split()[0].rpartition("/")[2]
        until(http, job, lambda now: now["delivered"][0]["state"] == "delivered")
    keys = {
        item["Key"]
        for item in by_boto(bucket).list_objects_v2(Bucket=bucket.name, Prefix="results/")["Contents"]
    }
    assert keys == {f"results/{scene.name}/result.zip", "results/far/result.zip"}
