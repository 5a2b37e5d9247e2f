"""Links without a key; files that need no sending; files that go to the store itself."""

from __future__ import annotations

import hashlib
import time
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any
from urllib.parse import parse_qs, urlencode, urlsplit

import httpx
import pytest
from psycopg.types.json import Jsonb

from service.http.problems import ProblemError
from service.routes.shares import _require_signature, _signature
from tests.service.conftest import problem
from tests.service.in_process import serving
from tests.workers.buckets import environment_of, fresh_bucket, moto_server
from tests.workers.conftest import anyio_backend, database_url, quick_settings, server, settings
from workers.database.database import open_database
from workers.settings.settings import Settings
from workers.tenants.api_keys import KeyStore

__all__ = ["anyio_backend", "database_url", "server", "settings"]
pytestmark = pytest.mark.anyio
NAME = "renders/ü 1.png"


def entry(path: str, content: bytes) -> dict[str, Any]:
    return {"path": path, "size": len(content), "sha256": hashlib.sha256(content).hexdigest()}


async def create(http: httpx.AsyncClient, *entries: dict[str, Any], **headers: str) -> dict[str, Any]:
    answer = await http.post("/v1/datasets", json={"manifest": entries}, headers=headers)
    assert answer.status_code == 201, answer.text
    found: dict[str, Any] = answer.json()
    return found


async def result(http: httpx.AsyncClient, settings: Settings, content: bytes) -> str:
    """A finished job whose one file has this content."""
    dataset = (await create(http))["id"]
    await http.put(f"/v1/datasets/{dataset}/files/a", content=content)
    stored = (await http.get(f"/v1/datasets/{dataset}/files")).json()["items"][0]
    await http.post(f"/v1/datasets/{dataset}/finalize")
    job = (await http.post("/v1/jobs", json={"dataset_id": dataset})).json()["id"]
    async with open_database(settings.require_database_url(), connections=1) as database:
        key = (await database.fetch("SELECT key FROM dataset_files WHERE dataset_id = %s", dataset))[0]["key"]
        artifact = {"name": NAME, "key": key, "size": stored["size"], "sha256": stored["sha256"]}
        await database.fetch(
            "UPDATE jobs SET state = 'succeeded', artifacts = %s WHERE id = %s",
            *(Jsonb([{**artifact, "media_type": "image/png"}]), job),
        )
    return str(job)


def test_a_signature_is_of_one_file_of_one_job_until_one_time_in_one_round_and_by_one_key():
    signed = (b"key", "job_1", NAME, 1000, 0)
    others = [(b"other", *signed[1:]), (b"key", "job_2", *signed[2:]), (*signed[:2], "report.json", 1000, 0)]
    others += [(*signed[:3], 1001, 0), (*signed[:4], 1)]
    assert len({_signature(*each) for each in (signed, *others)}) == 6
    made = _signature(*signed)
    for given, expires, code in (
        (made, 0, "link_expired"),
        (made[:-1], 2**40, "not_found"),
        (_signature(*others[0]), 2**40, "not_found"),
        ("ü", 2**40, "not_found"),
    ):
        with pytest.raises(ProblemError) as caught:
            _require_signature(made, expires, given)
        assert caught.value.code == code
    _require_signature(made, int(time.time()) + 60, made)


async def test_a_link_opens_one_file_for_its_time_and_nothing_else(settings: Settings):
    async with serving(settings) as http:
        job = await result(http, settings, b"0123456789")
        made = await http.post(f"/v1/jobs/{job}/shares", json={"name": NAME, "valid_s": 60})
        assert made.status_code == 201, made.text
        href = made.json()["href"]
        answer = await http.get(href, headers={"Range": "bytes=2-4"})
        assert (answer.status_code, answer.content) == (206, b"234")
        assert (await http.head(href)).headers["content-length"] == "10"
        other = await http.post(f"/v1/jobs/{job}/shares", json={"name": "none"})
        problem(other, 404, "not_found")
        parts = urlsplit(href)
        said = {name: values[0] for name, values in parse_qs(parts.query).items()}
        for wrong in [
            {**said, "expires": str(int(said["expires"]) + 1)},
            {**said, "signature": said["signature"][:-1]},
            {**said, "signature": "ü"},
        ]:
            problem(await http.get(f"{parts.path}?{urlencode(wrong)}"), 404, "not_found")
        problem(await http.get(f"{parts.path[:-5]}2.png?{parts.query}"), 404, "not_found")
        problem(await http.get(parts.path), 422, "invalid_request")
        brief = (await http.post(f"/v1/jobs/{job}/shares", json={"name": NAME, "valid_s": 1})).json()["href"]
        time.sleep(2.1)
        problem(await http.get(brief), 410, "link_expired")
    # Another replica, and a service that wants keys, know the link too.
    async with serving(settings.model_copy(update={"auth": "required"})) as http:
        assert (await http.get(href)).content == b"0123456789"
        problem(await http.post(f"/v1/jobs/{job}/shares", json={"name": NAME}), 401, "missing_credentials")


async def test_links_to_files_of_a_job_end_when_they_are_revoked_and_those_of_another_do_not(
    settings: Settings,
):
    async with serving(settings) as http:
        one, other = [await result(http, settings, content) for content in (b"one", b"other")]

        async def share(job: str) -> str:
            made = await http.post(f"/v1/jobs/{job}/shares", json={"name": NAME, "valid_s": 3600})
            found: str = made.json()["href"]
            return found

        first, others = await share(one), await share(other)
        for _ in range(2):
            assert (await http.get(first)).content == b"one"
            assert (await http.delete(f"/v1/jobs/{one}/shares")).status_code == 204
            problem(await http.get(first), 404, "not_found")
            assert (await http.get(others)).content == b"other"
            ended, first = first, await share(one)
            problem(await http.get(ended), 404, "not_found")
        problem(await http.delete("/v1/jobs/job_00000000000000000000000000/shares"), 404, "not_found")


async def test_what_a_tenant_has_sent_needs_no_sending_and_others_never_know(settings: Settings):
    ours, theirs = b"our photo", b"their photo"
    async with open_database(settings.require_database_url(), connections=1) as database:
        keys = KeyStore(database)
        one, other = [
            {"Authorization": f"Bearer {(await keys.create(tenant, tenant, ['read', 'datasets:write']))[1]}"}
            for tenant in ("one", "other")
        ]
    source = ""
    async with serving(settings) as http:
        for who, content in ((one, ours), (other, theirs)):
            dataset = (await create(http, **who))["id"]
            sent = await http.put(f"/v1/datasets/{dataset}/files/x.jpg", content=content, headers=who)
            assert sent.status_code == 201
            source = source or dataset
        manifest = [entry("a/1.jpg", ours), entry("a/2.jpg", theirs), {**entry("b.jpg", ours), "size": 1}]
        made = await create(http, *manifest, **one)
        assert (made["missing"], made["files"]) == (["a/2.jpg", "b.jpg"], 1)
        files = await http.get(f"/v1/datasets/{made['id']}/files", headers=one)
        assert [item["sha256"] for item in files.json()["items"]] == [manifest[0]["sha256"]]
        # The copy is its own: it outlives the dataset it came from.
        assert (await http.delete(f"/v1/datasets/{source}", headers=one)).status_code == 204
        path = f"/v1/datasets/{made['id']}/files/a/2.jpg"
        wrong = await http.put(path, content=b"another photo", headers=one)
        assert wrong.status_code == 201
        now = await http.get(f"/v1/datasets/{made['id']}", headers=one)
        assert now.json()["missing"] == ["a/2.jpg", "b.jpg"]
        refused = await http.post(f"/v1/datasets/{made['id']}/finalize", headers=one)
        problem(refused, 409, "dataset_not_complete")


@pytest.fixture
async def direct(database_url: str, tmp_path: Path) -> AsyncIterator[httpx.AsyncClient]:
    with moto_server() as address:
        said = {**environment_of(fresh_bucket(address)), "storage_presign": True}
        async with serving(quick_settings(tmp_path / "d", database_url=database_url, **said)) as http:
            yield http


async def test_files_sent_to_the_bucket_itself_count_once_they_are_verified(direct: httpx.AsyncClient):
    good, late = b"photo", b"another"
    dataset = (await create(direct, entry("a/ü.jpg", good), entry("b.jpg", late)))["id"]
    asked = {"files": [entry("a/ü.jpg", good), entry("b.jpg", late)]}
    signed = await direct.post(f"/v1/datasets/{dataset}/signed-uploads", json=asked)
    assert signed.status_code == 201, signed.text
    first, second = signed.json()["items"]
    complete = [f"/v1/uploads/{item['upload']['id']}/complete" for item in (first, second)]
    async with httpx.AsyncClient() as stranger:
        assert (await stranger.put(first["url"], content=good)).status_code == 200
        problem(await direct.post(complete[1]), 409, "upload_incomplete")
        problem(await direct.post(f"/v1/datasets/{dataset}/finalize"), 409, "dataset_not_complete")
        for wrong in (b"ANOTHER", b"longer than announced"):
            assert (await stranger.put(second["url"], content=wrong)).status_code == 200
            problem(await direct.post(complete[1]), 422, "digest_mismatch")
        assert (await direct.get(f"/v1/datasets/{dataset}")).json()["files"] == 0
        for _ in range(2):
            answer = await direct.post(complete[0])
            assert (answer.status_code, answer.json()["path"]) == (200, "a/ü.jpg")
        # What comes to the address after the proof changes nothing.
        assert (await stranger.put(first["url"], content=b"evil!")).status_code == 200
        assert (await stranger.put(second["url"], content=late)).status_code == 200
        assert (await direct.post(complete[1])).status_code == 200
    assert (await direct.get(f"/v1/datasets/{dataset}")).json()["missing"] == []
    assert (await direct.post(f"/v1/datasets/{dataset}/finalize")).json()["state"] == "ready"
    problem(await direct.post(f"/v1/datasets/{dataset}/signed-uploads", json=asked), 409, "dataset_not_open")


async def test_a_folder_has_no_addresses_to_give_out(settings: Settings):
    async with serving(settings) as http:
        dataset = (await create(http))["id"]
        body = {"files": [entry("a", b"x")]}
        answer = await http.post(f"/v1/datasets/{dataset}/signed-uploads", json=body)
        problem(answer, 409, "direct_upload_unavailable")
        assert (await http.post(f"/v1/datasets/{dataset}/finalize")).status_code == 409
