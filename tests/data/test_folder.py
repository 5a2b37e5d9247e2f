"""Folders: what is read of them, and what is not passed over in silence."""

from __future__ import annotations

import shutil

import pytest

from biresnerf.data.folder import look_into
from biresnerf.data.read import read_dataset
from biresnerf.errors import InputError
from tests.data.scenes import assert_complete, blender_scene, nerfstudio_scene, save, write_image


def test_transforms_json_wins_over_transforms_train_and_says_so(tmp_path):
    save(tmp_path, nerfstudio_scene(tmp_path))
    save(tmp_path, blender_scene(tmp_path), "transforms_train.json")
    dataset = read_dataset(tmp_path)
    assert dataset.source.dialect == "nerfstudio"
    assert dataset.warnings[0] == "transforms.json was read and transforms_train.json was not"


def test_transforms_train_is_read_where_it_is_alone(tmp_path):
    save(tmp_path, blender_scene(tmp_path), "transforms_train.json")
    assert read_dataset(tmp_path).source.file == tmp_path / "transforms_train.json"


def test_an_archives_single_folder_is_entered(tmp_path):
    inner = tmp_path / "scene"
    inner.mkdir()
    save(inner, nerfstudio_scene(inner))
    (tmp_path / "__MACOSX").mkdir()
    (tmp_path / ".hidden").touch()
    assert read_dataset(tmp_path).root == inner


@pytest.mark.parametrize("below", ["", "images", "images/left"])
def test_images_are_found_in_the_folder_or_below_images(tmp_path, below):
    for index in range(3):
        write_image(tmp_path / below / f"{index}.png")
    (tmp_path / "notes.txt").touch()
    contents = look_into(tmp_path)
    assert contents.transforms is None
    assert [path.name for path in contents.images] == ["0.png", "1.png", "2.png"]
    assert contents.root == tmp_path


def test_a_folder_without_images_is_refused(tmp_path):
    (tmp_path / "notes.txt").touch()
    with pytest.raises(InputError) as caught:
        read_dataset(tmp_path)
    assert_complete(caught.value, "no_images", tmp_path.name)


@pytest.mark.parametrize("name", ["sparse/0/cameras.bin", "poses_bounds.npy", "sparse_txt/cameras.txt"])
def test_poses_in_other_forms_are_not_thrown_away(tmp_path, name):
    for index in range(3):
        write_image(tmp_path / f"images/{index}.png")
    (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
    (tmp_path / name).touch()
    with pytest.raises(InputError) as caught:
        read_dataset(tmp_path)
    assert_complete(caught.value, "pose_format_unsupported", name)


def test_a_transforms_file_goes_before_other_forms(tmp_path):
    save(tmp_path, nerfstudio_scene(tmp_path))
    (tmp_path / "sparse/0").mkdir(parents=True)
    (tmp_path / "sparse/0/cameras.bin").touch()
    assert len(read_dataset(tmp_path)) == 4
    shutil.rmtree(tmp_path / "sparse")
