from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest

from biresnerf.client.scene import look_at
from biresnerf.data.formats.read_dataset import read_dataset
from biresnerf.errors import InputError
from tests.data.formats.simple import trajectories
from tests.data.scenes import write_image
from tests.service.conftest import scene_files


def contents(packed: list[tuple[str, Path]]) -> dict[str, bytes]:
    return {name: path.read_bytes() for name, path in packed}


@pytest.mark.parametrize("given", ["", "transforms.json"])
def test_what_is_sent_is_the_pose_file_and_the_images_it_names_and_nothing_else(
    scene: Path, tmp_path: Path, given: str
) -> None:
    copy = tmp_path / "copy"
    shutil.copytree(scene, copy)
    (copy / "train" / "unnamed.png").write_bytes(b"x")
    (copy / "notes.txt").write_text("private")
    packed = look_at(copy / given)
    assert contents(packed) == scene_files(scene)


def test_a_pose_file_of_another_name_is_sent_under_the_usual_one(scene: Path, tmp_path: Path) -> None:
    copy = tmp_path / "copy"
    shutil.copytree(scene, copy)
    (copy / "transforms.json").rename(copy / "poses.json")
    assert set(contents(look_at(copy / "poses.json"))) == set(scene_files(scene))


def test_images_alone_are_sent_with_their_folder(scene: Path, tmp_path: Path) -> None:
    shutil.copytree(scene / "train", tmp_path / "images")
    assert sorted(name for name, _ in look_at(tmp_path)) == [f"images/r_{i}.png" for i in range(6)]


def test_an_image_outside_of_the_folder_is_refused_with_a_hint(scene: Path, tmp_path: Path) -> None:
    inner = tmp_path / "inner"
    inner.mkdir()
    shutil.copytree(scene / "train", tmp_path / "train")
    document = json.loads((scene / "transforms.json").read_text())
    for frame in document["frames"]:
        frame["file_path"] = "../" + frame["file_path"].removeprefix("./")
    (inner / "transforms.json").write_text(json.dumps(document))
    with pytest.raises(InputError, match="biresnerf refine") as caught:
        look_at(inner)
    assert caught.value.code == "image_outside"


def test_what_is_not_there_is_said(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="does not exist"):
        look_at(tmp_path / "nothing")


@pytest.mark.parametrize(
    ("given", "sent"),
    [
        ("", ["sparse/0/cameras.txt", "sparse/0/images.txt", "sparse/0/points3D.txt"]),
        ("sparse/0", ["sparse/0/cameras.txt", "sparse/0/images.txt", "sparse/0/points3D.txt"]),
        ("poses_bounds.npy", ["poses_bounds.npy"]),
        ("walk.txt", ["trajectory.txt", "camera.json"]),
    ],
)
def test_poses_in_other_forms_are_sent_with_their_images_and_masks(
    tmp_path: Path, given: str, sent: list[str]
) -> None:
    trajectories.colmap_set(tmp_path)
    trajectories.llff_set(tmp_path)
    trajectories.tum_set(tmp_path, ["0", "1", "2", "3"]).rename(tmp_path / "walk.txt")
    write_image(tmp_path / "masks/a.png.png", mode="L")
    (tmp_path / "notes.txt").write_text("private")
    packed = look_at(tmp_path / given)
    images = [f"images/{name}" for name in trajectories.NAMES]
    assert [name for name, _ in packed] == [*sent, *images, "masks/a.png.png"]
    unpacked = tmp_path / "there"
    for name, content in contents(packed).items():
        (unpacked / name).parent.mkdir(parents=True, exist_ok=True)
        (unpacked / name).write_bytes(content)
    here, there = read_dataset(tmp_path / given), read_dataset(unpacked)
    assert there.source.dialect == here.source.dialect
    assert (there.world_from_cam == here.world_from_cam).all()
