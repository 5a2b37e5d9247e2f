from __future__ import annotations

import base64
import hashlib
import io
import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import httpx
import pytest
from PIL import Image

from service.intake.json_body import JSON_BYTES_MAX
from service.routes.datasets import ENTRY_BYTES
from tests.service.conftest import (
    LIMITS,
    Running,
    dataset_ids,
    new_dataset,
    problem,
    ready_dataset,
    scene_files,
    upload,
    zip_of,
)
from tests.service.spare_frames import three_frames

Files = dict[str, bytes]


def put(http: httpx.Client, dataset: str, path: str, content: bytes, **headers: str) -> httpx.Response:
    names = {name.replace("_", "-"): value for name, value in headers.items()}
    return http.put(f"/v1/datasets/{dataset}/files/{path}", content=content, headers=names)


def test_files_sent_one_by_one_make_a_ready_dataset(http: httpx.Client, scene: Path) -> None:
    dataset = new_dataset(http)
    for name, content in scene_files(scene).items():
        answer = put(http, dataset, name, content)
        assert answer.status_code == 201
        assert answer.json()["sha256"] == hashlib.sha256(content).hexdigest()
    assert put(http, dataset, "transforms.json", scene_files(scene)["transforms.json"]).status_code == 204
    answer = http.post(f"/v1/datasets/{dataset}/finalize")
    assert answer.status_code == 200, answer.text
    found = answer.json()
    assert (found["state"], found["files"]) == ("ready", 7)
    assert found["report"]["images"] == 6
    assert found["report"]["poses"] == "given"
    while found["expires_at"] is None:  # the next round of the dispatcher gives it a date
        time.sleep(0.05)
        found = http.get(f"/v1/datasets/{dataset}").json()
    again = http.post(f"/v1/datasets/{dataset}/finalize").json()
    # Who asks again keeps it for longer.
    assert again.pop("expires_at") >= found.pop("expires_at")
    assert again == found
    problem(put(http, dataset, "more.png", b"x"), 409, "dataset_not_open")
    problem(upload(http, dataset, zip_of({"more.png": b"x"})), 409, "dataset_not_open")


def test_a_manifest_may_be_as_long_as_a_dataset_may_have_files(http: httpx.Client) -> None:
    body = json.dumps({"name": "long", "manifest": []})
    room = JSON_BYTES_MAX + ENTRY_BYTES * LIMITS["max_files"]
    headers = {"Content-Type": "application/json"}
    taken = http.post("/v1/datasets", content=body.ljust(room), headers=headers)
    assert taken.status_code == 201, taken.text
    problem(http.post("/v1/datasets", content=body.ljust(room + 1), headers=headers), 413, "body_too_large")


def test_a_manifest_tells_what_is_missing(http: httpx.Client) -> None:
    manifest = [{"path": "a.png", "size": 1}, {"path": "b.png"}]
    dataset = http.post("/v1/datasets", json={"name": "m", "manifest": manifest}).json()
    assert dataset["missing"] == ["a.png", "b.png"]
    put(http, dataset["id"], "a.png", b"x")
    assert http.get(dataset["links"]["self"]).json()["missing"] == ["b.png"]
    body = problem(http.post(dataset["links"]["finalize"]), 409, "dataset_not_complete")
    assert "b.png" in body["detail"]


@pytest.mark.parametrize(
    "path",
    [
        "..%2fevil",
        "a/%2e%2e/b",
        "%2fetc/passwd",
        "a%5cb",
        "C:x",
        "a%00b",
        "a%09b",
        "a//b",
        "%ff.png",
        "x" * 256,
    ],
)
def test_an_unsafe_name_is_refused(http: httpx.Client, path: str) -> None:
    dataset = new_dataset(http)
    body = problem(put(http, dataset, path, b"x"), 422, "unsafe_path")
    assert body["where"]
    assert body["hint"]
    assert http.get(f"/v1/datasets/{dataset}").json()["files"] == 0


def test_a_file_over_the_limit_is_refused_with_and_without_its_length(http: httpx.Client) -> None:
    dataset = new_dataset(http)
    content = bytes(2 * 2**20 + 1)
    problem(put(http, dataset, "a.png", content), 413, "body_too_large")
    chunks = (content[start : start + 65536] for start in range(0, len(content), 65536))
    problem(http.put(f"/v1/datasets/{dataset}/files/a.png", content=chunks), 413, "body_too_large")
    assert http.get(f"/v1/datasets/{dataset}").json()["files"] == 0


def test_more_files_than_the_limit_are_refused(http: httpx.Client) -> None:
    dataset = new_dataset(http)
    assert upload(http, dataset, zip_of({f"{i}.txt": b"x" for i in range(120)})).status_code == 200
    problem(put(http, dataset, "more.txt", b"x"), 413, "too_many_files")
    problem(upload(http, dataset, zip_of({"more.txt": b"x"})), 413, "too_many_files")
    assert put(http, dataset, "7.txt", b"other").status_code == 204


def test_a_digest_is_held_against_the_bytes(http: httpx.Client) -> None:
    dataset = new_dataset(http)
    digest = f"sha-256=:{base64.b64encode(hashlib.sha256(b'x').digest()).decode()}:"
    assert put(http, dataset, "a.txt", b"x", repr_digest=digest).status_code == 201
    problem(put(http, dataset, "b.txt", b"y", repr_digest=digest), 422, "digest_mismatch")
    problem(put(http, dataset, "b.txt", b"y", repr_digest="sha-256=:AAAA:"), 400, "malformed_body")
    assert http.get(f"/v1/datasets/{dataset}").json()["files"] == 1


def test_a_file_is_not_replaced_against_the_clients_wish(http: httpx.Client) -> None:
    dataset = new_dataset(http)
    put(http, dataset, "a.txt", b"x")
    problem(put(http, dataset, "a.txt", b"y", if_none_match="*"), 412, "file_exists")


def test_names_equal_but_for_case_stop_the_finalizing_and_can_be_mended(
    http: httpx.Client, scene: Path
) -> None:
    dataset = new_dataset(http)
    put(http, dataset, "a.png", b"x")
    put(http, dataset, "A.png", b"x")
    problem(http.post(f"/v1/datasets/{dataset}/finalize"), 422, "name_collision")
    assert http.get(f"/v1/datasets/{dataset}").json()["state"] == "open"


def picture(mode: str = "RGB", size: tuple[int, int] = (32, 32), kind: str = "PNG") -> bytes:
    buffer = io.BytesIO()
    Image.new(mode, size).save(buffer, kind)
    return buffer.getvalue()


def edited(change: Callable[[dict[str, Any]], object]) -> Callable[[Files], object]:
    def apply(files: Files) -> None:
        document = json.loads(files["transforms.json"])
        change(document)
        files["transforms.json"] = json.dumps(document).encode()

    return apply


def with_frame(**values: Any) -> Callable[[Files], object]:
    return edited(lambda document: document["frames"][2].update(values))


def with_entry(value: float) -> Callable[[Files], object]:
    return edited(lambda document: document["frames"][2]["transform_matrix"][0].__setitem__(0, value))


# What is done to the good scene, the code (None: any), and what the answer must name.
BAD: dict[str, tuple[Callable[[Files], object], str | None, str]] = {
    "image cut short": (lambda f: f.update({"train/r_2.png": f["train/r_2.png"][:-200]}), None, "r_2"),
    "image of no bytes": (lambda f: f.update({"train/r_2.png": b""}), "not_an_image", "r_2"),
    "text called png": (lambda f: f.update({"train/r_2.png": b"hello"}), "not_an_image", "r_2"),
    "another size": (lambda f: f.update({"train/r_2.png": picture(size=(40, 32))}), None, "r_2"),
    "image missing": (lambda f: f.pop("train/r_2.png"), None, "r_2"),
    "no images at all": (
        lambda f: [f.pop(name) for name in list(f) if name.endswith("png")],
        None,
        "transforms.json",
    ),
    "two images only": (edited(lambda d: d.update(frames=d["frames"][:2])), None, "transforms.json"),
    "same name twice": (with_frame(file_path="./train/r_1"), None, "r_1"),
    "frame without name": (edited(lambda d: d["frames"][2].pop("file_path")), None, "transforms.json"),
    "NaN in a pose": (with_entry(float("nan")), None, ""),
    "no rotation": (with_entry(3.0), None, ""),
    "unknown camera model": (edited(lambda d: d.update(camera_model="PANINI")), None, "camera_model"),
    "half a lens": (edited(lambda d: (d.pop("camera_angle_x"), d.update(k1=0.1))), None, "transforms.json"),
    "frames is no list": (edited(lambda d: d.update(frames=7)), None, "transforms.json"),
    "broken JSON": (lambda f: f.update({"transforms.json": b'{"frames": ['}), None, "transforms.json"),
    "JSON bomb": (lambda f: f.update({"transforms.json": b"[" * 10**6}), None, "transforms.json"),
    "neither images nor poses": (lambda f: (f.clear(), f.update({"readme.txt": b"x"})), "no_images", ""),
    "name of somebody else's file": (with_frame(file_path="/etc/passwd"), None, "/etc/passwd"),
    "name above the dataset": (with_frame(file_path="../../../../../../etc/hostname"), None, ""),
}


@pytest.mark.parametrize("case", BAD)
def test_a_bad_scene_is_422_with_the_file_and_the_hint(http: httpx.Client, scene: Path, case: str) -> None:
    change, code, names = BAD[case]
    files = three_frames(scene_files(scene))
    change(files)
    dataset = new_dataset(http)
    assert upload(http, dataset, zip_of(files)).status_code == 200
    answer = http.post(f"/v1/datasets/{dataset}/finalize")
    body = problem(answer, 422 if answer.status_code != 413 else 413, code or answer.json()["code"])
    assert body["code"] not in {"internal_error", "check_crashed", "check_timeout"}
    assert names in f"{body.get('where')} {body['detail']}"
    assert body["hint"]
    assert str(http.base_url.host) not in body["detail"]
    assert "/data/scratch" not in answer.text  # no paths of the server
    found = http.get(f"/v1/datasets/{dataset}").json()
    assert (found["state"], found["error"]["code"]) == ("rejected", body["code"])
    problem(http.post("/v1/jobs", json={"dataset_id": dataset}), 409, "dataset_not_ready")


def test_a_bad_photo_among_good_ones_is_left_out_and_named(http: httpx.Client, scene: Path) -> None:
    dataset = new_dataset(http)
    assert upload(http, dataset, zip_of({**scene_files(scene), "train/r_2.png": b"hello"})).status_code == 200
    found = http.post(f"/v1/datasets/{dataset}/finalize").json()
    assert (found["state"], found["report"]["images"]) == ("ready", 5)
    assert any("r_2" in warning for warning in found["report"]["warnings"])


def test_the_same_bad_scene_in_one_request_is_the_same_problem(http: httpx.Client, scene: Path) -> None:
    files = three_frames(scene_files(scene))
    files["train/r_2.png"] = b"hello"
    before = dataset_ids(http)
    body = problem(http.post("/v1/jobs", files={"archive": zip_of(files)}), 422, "not_an_image")
    assert "r_2" in body["where"]
    assert dataset_ids(http) == before


def test_another_datasets_files_cannot_be_named(http: httpx.Client, service: Running, scene: Path) -> None:
    ready_dataset(http, scene)
    victim = next((service.data_dir / "files" / "datasets").rglob("r_2.png"))
    files = three_frames(scene_files(scene))
    files.pop("train/r_2.png")
    with_frame(file_path=str(victim))(files)
    dataset = new_dataset(http)
    upload(http, dataset, zip_of(files))
    assert http.post(f"/v1/datasets/{dataset}/finalize").status_code == 422


def test_uploaded_python_files_are_never_run(http: httpx.Client, scene: Path, tmp_path: Path) -> None:
    mark = tmp_path / "ran"
    code = f"open({str(mark)!r}, 'w').write('ran')\nraise SystemExit(0)\n".encode()
    names = (
        "json",
        "PIL/__init__",
        "numpy/__init__",
        "workers/__init__",
        "biresnerf/__init__",
        "sitecustomize",
    )
    files = {**scene_files(scene), **{f"{name}.py": code for name in names}}
    dataset = new_dataset(http)
    assert upload(http, dataset, zip_of(files)).status_code == 200
    answer = http.post(f"/v1/datasets/{dataset}/finalize")
    assert not mark.exists()
    assert answer.status_code == 200, answer.text


def test_a_check_asked_for_in_the_background_ends_by_itself(http: httpx.Client, scene: Path) -> None:
    dataset = new_dataset(http)
    upload(http, dataset, zip_of(scene_files(scene)))
    answer = http.post(f"/v1/datasets/{dataset}/finalize", headers={"Prefer": "respond-async"})
    assert answer.status_code == 202
    assert answer.json()["state"] == "finalizing"
    assert http.post(f"/v1/datasets/{dataset}/finalize").json()["state"] == "ready"


def test_datasets_and_files_are_listed_page_by_page(http: httpx.Client, scene: Path) -> None:
    dataset = ready_dataset(http, scene)
    url, names = f"/v1/datasets/{dataset}/files?limit=3", []
    while url:
        answer = http.get(url)
        names += [item["path"] for item in answer.json()["items"]]
        url = answer.links.get("next", {}).get("url")
    assert names == sorted(scene_files(scene))
    assert http.get("/v1/datasets?limit=1").json()["items"][0]["id"] == dataset
    problem(http.get("/v1/datasets?cursor=nonsense"), 400, "bad_cursor")
    problem(http.get("/v1/datasets?limit=0"), 422, "invalid_request")


def test_a_file_of_an_open_dataset_can_be_deleted_and_the_dataset_closed(http: httpx.Client) -> None:
    dataset = new_dataset(http)
    files = f"/v1/datasets/{dataset}/files"
    for path in ("a.png", "A.png"):
        assert http.put(f"{files}/{path}", content=b"x").status_code == 201
    problem(http.post(f"/v1/datasets/{dataset}/finalize"), 422, "name_collision")
    assert http.delete(f"{files}/A.png").status_code == 204
    problem(http.delete(f"{files}/A.png"), 404, "not_found")
    assert [file["path"] for file in http.get(files).json()["items"]] == ["a.png"]
    assert http.get(f"/v1/datasets/{dataset}").json()["bytes"] == 1
    http.post(f"/v1/datasets/{dataset}/finalize")
    problem(http.delete(f"{files}/a.png"), 409, "dataset_not_open")


def test_a_packed_body_is_refused_and_not_stored_as_it_is(http: httpx.Client) -> None:
    dataset, packed = new_dataset(http), {"Content-Encoding": "gzip"}
    sent = http.put(f"/v1/datasets/{dataset}/files/a.png", content=b"x", headers=packed)
    assert problem(sent, 415, "unsupported_media")["where"] == "Content-Encoding"
    problem(http.post("/v1/datasets", json={}, headers=packed), 415, "unsupported_media")
    assert http.get(f"/v1/datasets/{dataset}").json()["files"] == 0
