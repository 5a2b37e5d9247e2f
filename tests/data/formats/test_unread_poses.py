"""Unsupported pose files of other programs are named; files that only look like them are not."""

from __future__ import annotations

import json

import numpy as np
import pytest
from PIL import Image

from biresnerf.data.formats.read_dataset import read_dataset
from biresnerf.data.formats.unread_poses import UNREAD
from biresnerf.errors import InputError

# The beginning of a file as each program's documentation shows it.
FILES = {
    "block.xml": '<?xml version="1.0"?>\n<BlocksExchange version="2.1">',
    "p4d_calibrated_external_camera_parameters.txt": "imageName X Y Z Omega Phi Kappa\n",
    "scene.nvm": "NVM_V3\n\n4\n",
    "scene.mvs": "MVS\x00",
    "odometry.csv": "timestamp, frame, x, y, z, qx, qy, qz, qw\n",
    "extri.yml": "%YAML:1.0\n---\nR_0: !!opencv-matrix\n  rows: 3\n",
    "lowres_wide.traj": "3845.6 0.1 0.2 0.3 1.5e-3 0.5 0.6\n",
}


@pytest.fixture
def photos(tmp_path):
    (tmp_path / "images").mkdir()
    for number in range(4):
        Image.new("RGB", (32, 32), (number, 0, 0)).save(tmp_path / "images" / f"{number}.png")
    return tmp_path


@pytest.mark.parametrize("name", FILES)
def test_the_form_is_named(photos, name):
    (photos / name).parent.mkdir(parents=True, exist_ok=True)
    (photos / name).write_text(FILES[name])
    with pytest.raises(InputError) as caught:
        read_dataset(photos)
    assert (caught.value.code, caught.value.where) == ("poses_not_read", name)


@pytest.mark.parametrize("name", FILES)
def test_in_a_folder_below_the_form_is_named_and_the_photos_are_read(photos, name):
    (photos / "old").mkdir()
    (photos / "old" / name).write_text(FILES[name])
    dataset = read_dataset(photos)
    assert len(dataset) == 4
    assert any(f"old/{name} holds camera poses of" in text for text in dataset.warnings)


def test_every_form_is_tried():
    assert len(UNREAD) == len(FILES)


def test_other_files_of_such_names_are_left_alone(photos):
    for name in (
        "notes.csv",
        "images/0.xmp",
        "run.log",
        "metadata.json",
        "meta_data.json",
        "a.xml",
        "camera/0.json",
    ):
        (photos / name).parent.mkdir(exist_ok=True)
        (photos / name).write_text('{"of": "another program"}')
    assert len(read_dataset(photos)) == 4


def rows(numbers: int, count: int = 4) -> str:
    """``count`` lines of so many numbers."""
    return "".join(" ".join(f"{i + j / 7:.4f}" for j in range(numbers)) + "\n" for i in range(count))


def lists(numbers: int, count: int = 4) -> list[list[float]]:
    return [[i + j / 7 for j in range(numbers)] for i in range(count)]


CAMERA = "R_{0}: !!opencv-matrix\n   rows: 3\n   data: [ 1., 0., 0., 0., 1., 0., 0., 0., 1. ]\n"
POSE_LIKE = {
    "seven.txt": rows(7),
    "times.txt": rows(8, 100),
    "twelve.csv": rows(12).replace(" ", ","),
    "sixteen.txt": rows(16),
    "blocks.dat": rows(4, 16),
    "below/here/list.json": json.dumps({"extrinsics": lists(16)}, indent=1),
    "nested.json": json.dumps([lists(4, 3)] * 4),
    "named.json": json.dumps(
        {f"p{i}.png": {"position": [1, 2, 3], "rotation": [1, 0, 0, 0]} for i in range(4)}
    ),
    "named.txt": "".join(f"seq/p{i}.png 1 2 3 1 0 0 0\n" for i in range(4)),
    "stems.xml": "".join(
        f'<camera name="p{i}" x="1" y="2" z="3" a="0" b="0" c="0" d="1"/>' for i in range(4)
    ),
    "cameras.yml": "%YAML:1.0\n---\n" + "".join(CAMERA.format(i) for i in range(4)),
}


@pytest.fixture
def named_photos(tmp_path):
    for number in range(4):
        (tmp_path / "images").mkdir(exist_ok=True)
        Image.new("RGB", (32, 32), (number, 0, 0)).save(tmp_path / "images" / f"p{number}.png")
    return tmp_path


@pytest.mark.parametrize("name", POSE_LIKE)
def test_a_file_with_numbers_as_poses_have_them_is_named(named_photos, name):
    (named_photos / name).parent.mkdir(parents=True, exist_ok=True)
    (named_photos / name).write_text(POSE_LIKE[name])
    dataset = read_dataset(named_photos)
    assert dataset.source.dialect == "images"
    assert any(f"{name} may hold poses" in text for text in dataset.warnings), dataset.warnings


@pytest.mark.parametrize("shape", [(4, 4, 4), (4, 3, 4), (4, 7)])
def test_an_array_of_matrices_is_named(named_photos, shape):
    np.save(named_photos / "c2w.npy", np.zeros(shape))
    assert any("c2w.npy may hold poses" in text for text in read_dataset(named_photos).warnings)


def test_a_file_each_beside_the_photos_is_named_once(named_photos):
    for number in range(4):
        (named_photos / f"images/p{number}.png.camera").write_text(rows(3, 9))
    assert [text for text in read_dataset(named_photos).warnings if "poses" in text] == [
        "images/p0.png.camera and 3 like it may hold poses, by what numbers they hold, and were not read: "
        "give poses in one of the forms of docs/formats.md"
    ]


OTHERS = {
    "points.txt": rows(6, 500),
    "many.txt": rows(7, 3000),
    "rgb.txt": "".join(f"{i}.5 images/p{i}.png\n" for i in range(4)),
    "labels.json": json.dumps([{"file": f"p{i}.png", "class": "cat", "score": 0.5} for i in range(4)]),
    "readme.txt": "Four photos of a cat, taken on 3 May 2021 with a 35 mm lens at f/2.\n" * 8,
    "out/poses.txt": rows(12),
    "out/report.json": "{}",
    "out/config.json": "{}",
}


def test_other_files_are_not_taken_for_poses(named_photos):
    for name, text in OTHERS.items():
        (named_photos / name).parent.mkdir(exist_ok=True)
        (named_photos / name).write_text(text)
    for number in range(4):  # boxes of objects, as detectors label them
        (named_photos / f"images/p{number}.txt").write_text(rows(5, number + 1))
    assert not [text for text in read_dataset(named_photos).warnings if "poses" in text]
