"""What pages show of a checked dataset, and sets that wait for their first job."""

from __future__ import annotations

import io
import json
from pathlib import Path
from typing import Any

import httpx
from PIL import Image

from tests.service.conftest import (
    Tenant,
    dataset_ids,
    new_dataset,
    problem,
    ready_dataset,
    scene_files,
    submit,
    upload,
    zip_of,
)


def test_the_photos_of_a_checked_set_are_shown_to_its_tenant_alone(
    tenants: tuple[Tenant, Tenant], scene: Path
) -> None:
    mine, other = (tenant.http for tenant in tenants)
    dataset = new_dataset(mine)
    place = f"/v1/datasets/{dataset}"
    problem(mine.get(f"{place}/photos"), 404, "not_found")
    upload(mine, dataset, zip_of(scene_files(scene)))
    assert mine.post(f"{place}/finalize").json()["report"]["expected_s"]["fast"] > 0
    found = mine.get(f"{place}/photos").json()
    names = [Path(frame["file_path"]).stem for frame in transforms_of(scene)["frames"]]
    assert [Path(photo["name"]).stem for photo in found["photos"]] == names
    assert all(len(photo["world_from_cam"]) == 3 for photo in found["photos"])
    for name in ("photos.jpg", "thumbnail.jpg"):
        answer = mine.get(f"{place}/{name}")
        assert (answer.status_code, answer.headers["content-type"]) == (200, "image/jpeg")
        assert Image.open(io.BytesIO(answer.content)).format == "JPEG"
        etag = answer.headers["etag"]
        assert mine.get(f"{place}/{name}", headers={"If-None-Match": etag}).status_code == 304
        problem(other.get(f"{place}/{name}"), 404, "not_found")
    problem(other.get(f"{place}/photos"), 404, "not_found")
    assert mine.delete(place).status_code == 204
    problem(mine.get(f"{place}/photos.jpg"), 404, "not_found")


def transforms_of(scene: Path) -> dict[str, Any]:
    found: dict[str, Any] = json.loads(scene_files(scene)["transforms.json"])
    return found


def test_sets_without_a_job_are_listed_apart(http: httpx.Client, scene: Path) -> None:
    waiting = [new_dataset(http), ready_dataset(http, scene)]
    started = ready_dataset(http, scene)
    submit(http, started)
    listed = http.get("/v1/datasets", params={"unused": True, "limit": 200}).json()["items"]
    found = {item["id"] for item in listed}
    assert {*waiting} <= found
    assert started not in found
    assert started in dataset_ids(http)
