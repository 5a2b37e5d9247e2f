"""What pages show of a checked dataset, and sets that wait for their first job."""

from __future__ import annotations

import io
import json
from pathlib import Path
from typing import Any

import httpx
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from biresnerf.data.photos.image_files import EXIF_ORIENTATION
from tests.service.conftest import (
    Running,
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
    assert mine.post(f"{place}/finalize").json()["report"]["expected_s"]["fast"][0] > 0
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


def test_a_photo_and_its_mask_are_shown_as_its_pose_means_them(tenants: tuple[Tenant, Tenant]) -> None:
    mine, other = (tenant.http for tenant in tenants)
    stored, counts = stripes(1600, 1200), np.zeros((1600, 1200), dtype=bool)
    counts[:400, 300:] = True
    poses = np.tile(np.eye(4), (3, 1, 1))
    poses[:, 0, 3] = range(3)
    frames: list[dict[str, Any]] = [
        {"file_path": f"{i}.jpg", "transform_matrix": pose.tolist()} for i, pose in enumerate(poses)
    ]
    frames[1]["mask_path"] = "away.png"
    # As a phone stores an upright photo: on its side, with a tag.
    upright: Any = {"camera_model": "OPENCV", "w": 1200, "h": 1600, "fl_x": 1000.0, "frames": frames}
    tag = Image.Exif()
    tag[EXIF_ORIENTATION] = 6
    photo = encoded(stored, "JPEG", exif=tag, quality=95)
    files = {f"{i}.jpg": photo for i in range(3)}
    files |= {"away.png": encoded(counts, "PNG"), "transforms.json": json.dumps(upright).encode()}
    dataset = new_dataset(mine)
    upload(mine, dataset, zip_of(files))
    assert mine.post(f"/v1/datasets/{dataset}/finalize").json()["state"] == "ready"
    place = f"/v1/datasets/{dataset}/photos"
    listed = mine.get(place).json()["photos"]
    assert [photo["path"] for photo in listed] == ["0.jpg", "1.jpg", "2.jpg"]
    assert listed[0]["mask"] == {"path": "dynamic_mask_0.png", "inverted": True}
    assert listed[1]["mask"] == {"path": "away.png", "inverted": False}
    shown = np.asarray(Image.open(io.BytesIO(mine.get(f"{place}/1/picture.jpg").content)), float)
    meant = Image.fromarray(stored).transpose(Image.Transpose.ROTATE_270).resize((960, 1280))
    assert shown.shape == (1280, 960, 3)
    assert np.abs(shown - np.asarray(meant, float)).mean() < 4
    mask = np.asarray(Image.open(io.BytesIO(mine.get(f"{place}/1/mask.png").content)))
    assert mask.shape == (1280, 960)
    assert mask[:320, 240:].all()
    assert mask.sum() == 320 * 720
    problem(mine.get(f"{place}/0/mask.png"), 404, "not_found")
    problem(mine.get(f"{place}/3/picture.jpg"), 404, "not_found")
    problem(other.get(f"{place}/1/picture.jpg"), 404, "not_found")
    problem(mine.get(f"{place}/-1/picture.jpg"), 422, "invalid_request")


def test_a_browser_that_has_a_picture_is_told_so_without_reading_the_photo(
    tenants: tuple[Tenant, Tenant], closed: Running
) -> None:
    mine = tenants[0].http
    photo, away = encoded(stripes(61, 47), "JPEG"), np.zeros((47, 61), dtype=bool)
    away[:, :7] = True
    files = {"0.jpg": photo, "1.jpg": encoded(stripes(61, 47)[::-1], "JPEG"), "2.jpg": photo}
    files["dynamic_mask_0.png"] = encoded(away, "PNG")
    poses: Any = {"camera_model": "PINHOLE", "w": 61, "h": 47, "fl_x": 60.0, "frames": []}
    poses["frames"] = [{"file_path": f"{i}.jpg", "transform_matrix": shifted(i)} for i in range(3)]
    dataset = new_dataset(mine)
    upload(mine, dataset, zip_of(files | {"transforms.json": json.dumps(poses).encode()}))
    assert mine.post(f"/v1/datasets/{dataset}/finalize").json()["state"] == "ready"
    place = f"/v1/datasets/{dataset}/photos"
    pictures = ("0/picture.jpg", "0/mask.png", "1/picture.jpg", "2/picture.jpg")
    tags = [mine.get(f"{place}/{name}").headers["etag"] for name in pictures]
    assert len(set(tags)) == len(pictures)
    known = {"If-None-Match": tags[0]}
    stored = [path for path in closed.data_dir.rglob("*") if path.is_file() and path.read_bytes() == photo]
    assert stored
    for path in stored:
        path.unlink()
    assert mine.get(f"{place}/0/picture.jpg").is_error, "the photo is gone"
    answer = mine.get(f"{place}/0/picture.jpg", headers=known)
    assert (answer.status_code, answer.headers["etag"], answer.content) == (304, tags[0], b"")
    assert mine.get(f"{place}/1/picture.jpg", headers=known).status_code == 200


def shifted(by: float) -> list[list[float]]:
    pose = np.eye(4)
    pose[0, 3] = by
    shown: list[list[float]] = pose.tolist()
    return shown


def stripes(width: int, height: int) -> NDArray[np.uint8]:
    """A picture that looks like none of its turned copies."""
    across, down = np.meshgrid(np.linspace(0, 255, width), np.linspace(0, 255, height))
    return np.stack([across, down, np.zeros_like(down)], axis=-1).astype(np.uint8)


def encoded(picture: NDArray[Any], kind: str, **how: Any) -> bytes:
    file = io.BytesIO()
    Image.fromarray(picture).save(file, kind, **how)
    return file.getvalue()


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
