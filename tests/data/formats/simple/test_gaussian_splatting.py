"""cameras.json of 3D Gaussian Splatting: poses, lenses and names as its source writes them."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from biresnerf.data.formats.read_dataset import read_dataset, read_poses
from biresnerf.errors import InputError
from tests.data.formats.random_sets import random_poses
from tests.data.scenes import assert_complete, write_image
from tests.data.test_real_sets import ROOT

REAL = ROOT / "interop/05_poses_silently_ignored/3dgs_cameras/cameras.json"


def camera_to_json(index: int, name: str, world_from_cam: np.ndarray) -> dict[str, Any]:
    """As camera_to_JSON does it: from the world-to-camera matrix that 3DGS keeps, inverted again."""
    cam_from_world = np.linalg.inv(world_from_cam)
    inverse = np.linalg.inv(cam_from_world)
    return {
        "id": index, "img_name": name, "width": 20, "height": 16, "position": inverse[:3, 3].tolist(),
        "rotation": [row.tolist() for row in inverse[:3, :3]], "fy": 17.0, "fx": 18.0,
    }  # fmt: skip


def write_set(folder: Path, suffix: str = "") -> np.ndarray:
    poses = random_poses(np.random.default_rng(0), 4)
    rows = []
    for index, pose in enumerate(poses):
        write_image(folder / f"images/view_{index}.png", index)
        rows.append(camera_to_json(index, f"view_{index}{suffix}", pose))
    (folder / "cameras.json").write_text(json.dumps(rows[::-1]))
    return poses[::-1]


@pytest.mark.parametrize("suffix", ["", ".png"])
def test_each_image_gets_the_pose_and_lens_of_its_name(tmp_path, suffix):
    poses = write_set(tmp_path, suffix)
    for path in (tmp_path, tmp_path / "cameras.json"):
        dataset = read_dataset(path)
        assert dataset.source.dialect == "gaussian-splatting"
        assert dataset.file_names == tuple(f"images/view_{index}.png" for index in (3, 2, 1, 0))
        np.testing.assert_allclose(dataset.world_from_cam, poses, atol=1e-12)
        [camera] = dataset.cameras
        assert (camera.model, camera.params) == ("PINHOLE", (18.0, 17.0, 10.0, 8.0))


def test_a_file_of_that_name_by_another_program_is_not_taken_for_it(tmp_path):
    for index in range(3):
        write_image(tmp_path / f"images/{index}.png", index)
    (tmp_path / "cameras.json").write_text('{"cameras": []}')
    assert not read_dataset(tmp_path).posed.any()


@pytest.mark.parametrize(
    ("key", "value", "code"),
    [
        ("position", [0, 0], "pose_file_invalid"),
        ("position", [0, 0, "far"], "pose_file_invalid"),
        ("position", [0, 0, float("inf")], "pose_not_finite"),
        ("rotation", [[2, 0, 0], [0, 2, 0], [0, 0, 2]], "pose_not_rotation"),
        ("fx", 0, "intrinsics_invalid"),
        ("img_name", "../view_1", "unsafe_path"),
        ("img_name", "view_2", "duplicate_image"),
        ("img_name", "elsewhere", "image_missing"),
    ],
)
def test_a_bad_camera_is_named(tmp_path, key, value, code):
    write_set(tmp_path)
    file = tmp_path / "cameras.json"
    rows = json.loads(file.read_text())
    rows[0][key] = value
    file.write_text(json.dumps(rows))
    with pytest.raises(InputError) as caught:
        read_dataset(tmp_path, strict=True)
    assert_complete(caught.value, code, "cameras.json")


def test_a_real_file_is_read_as_its_numbers_say(tmp_path):
    if not REAL.is_file():
        pytest.skip(f"no file {REAL.name}: set BIRESNERF_TEST_DATA to the folder that holds it")
    rows = json.loads(REAL.read_text())
    for row in rows:
        (tmp_path / "images").mkdir(exist_ok=True)
        size = (row["width"], row["height"])
        Image.new("L", size).save(tmp_path / "images" / row["img_name"], format="JPEG")
    (tmp_path / "cameras.json").write_bytes(REAL.read_bytes())
    dataset = read_dataset(tmp_path)
    assert len(dataset) == len(rows) == 14
    for row, pose in zip(rows, dataset.world_from_cam, strict=True):
        np.testing.assert_allclose(pose[:3, 3], row["position"])
        np.testing.assert_allclose(pose[:3, :3], row["rotation"], atol=1e-5)
    assert read_poses(tmp_path / "cameras.json").keys() == {row["img_name"] for row in rows}
