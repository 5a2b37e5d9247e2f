"""Poses and photos that do not lie beside each other in the set's folder are found, and the choice is reported."""

from __future__ import annotations

import shutil

import pytest

from biresnerf.client.scene import look_at
from biresnerf.data.formats.folder import look_into
from biresnerf.data.formats.read_dataset import read_dataset
from biresnerf.errors import InputError
from tests.data.formats.simple.trajectories import NAMES, assert_at_truth, colmap_set, write_images
from tests.data.scenes import nerfstudio_scene, save, write_image


@pytest.mark.parametrize("place", ["colmap_text", "dslr/colmap", "a/dense/0/sparse", "sparse/3"])
def test_a_colmap_model_is_found_in_any_folder(tmp_path, place):
    model = colmap_set(tmp_path)
    (tmp_path / place).parent.mkdir(parents=True, exist_ok=True)
    shutil.move(model, tmp_path / place)
    dataset = read_dataset(tmp_path)
    assert_at_truth(dataset)
    assert dataset.root == tmp_path
    assert place.startswith("sparse") or f"poses were read from {place}" in dataset.warnings


def test_the_numbered_model_with_most_images_is_read_and_the_others_are_counted(tmp_path):
    shutil.move(colmap_set(tmp_path), tmp_path / "largest")
    colmap_set(tmp_path, registered=2)
    shutil.move(tmp_path / "largest", tmp_path / "sparse/1")
    dataset = read_dataset(tmp_path)
    assert_at_truth(dataset)
    assert any("sparse/1 (4 images) was read, and not sparse/0 (2)" in text for text in dataset.warnings)
    assert int(read_dataset(tmp_path / "sparse/0/images.txt").posed.sum()) == 2  # it was asked for


@pytest.mark.parametrize("names", [NAMES, tuple(f"images/{name}" for name in NAMES)])
def test_photos_of_a_model_are_found_by_its_names_in_the_folder_of_the_largest(tmp_path, names):
    colmap_set(tmp_path)
    table = tmp_path / "sparse/0/images.txt"
    for name, written in zip(NAMES, names, strict=True):
        table.write_text(table.read_text().replace(f" {name}", f" {written}"))
    shutil.move(tmp_path / "images", tmp_path / "images_4")
    for index, name in enumerate(NAMES):
        write_image(tmp_path / "images_8" / name, index, (10, 8))
        write_image(tmp_path / "other" / f"{index}.png", index)
    dataset = read_dataset(tmp_path)
    assert_at_truth(dataset)
    assert {frame.path.parent.name for frame in dataset.frames} == {"images_4"}


def test_a_model_with_photos_beside_it_goes_before_one_without(tmp_path):
    dense = tmp_path / "dense"
    for path in colmap_set(dense).iterdir():
        shutil.copy(path, tmp_path)
    lens = "OPENCV 40 32 36 37 20 16 0.1 0 0 0"  # of the photos before they were straightened
    (tmp_path / "cameras.txt").write_text(f"1 {lens}\n")
    dataset = read_dataset(tmp_path)
    assert_at_truth(dataset)
    assert dataset.cameras[0].model == "PINHOLE"
    assert "dense/sparse/0 was read and the folder itself was not" in dataset.warnings


@pytest.mark.parametrize("whole", [True, False])
def test_photos_in_a_folder_beside_that_of_a_transforms_file_are_found(tmp_path, whole):
    document = nerfstudio_scene(tmp_path / "photos")
    place = tmp_path / "nerfstudio"
    place.mkdir()
    file = save(place, document)
    dataset = read_dataset(tmp_path if whole else file)
    assert dataset.root == tmp_path
    assert {frame.path.parent for frame in dataset.frames} == {tmp_path / "photos/images"}
    assert next(name for name, _ in look_at(file)) == "nerfstudio/transforms.json"


def test_photos_of_other_parts_of_a_set_and_those_without_an_entry_are_said(tmp_path):
    """NeRF++: train/rgb with train/pose, and the photos of test/ and validation/ beside."""
    train = tmp_path / "train"
    for index in range(4):
        write_image(train / "rgb" / f"{index}.png", index)
        (train / "pose").mkdir(exist_ok=True)
        (train / "pose" / f"{index}.txt").write_text(f"1 0 0 {index}  0 1 0 0  0 0 1 0  0 0 0 1")
    write_image(tmp_path / "test/rgb/0.png", 7)  # called as one of the others is
    assert not any("left out" in text for text in read_dataset(train).warnings)
    (note,) = (text for text in read_dataset(tmp_path).warnings if "left out" in text)
    assert "test/rgb/ (1)" in note
    assert "--fixed-from" in note
    write_image(tmp_path / "validation/9.png", 8)
    write_image(train / "rgb/more.png", 9)
    dataset = read_dataset(tmp_path)
    assert len(dataset) == 4
    parts, beside = (text for text in dataset.warnings if "left out" in text)
    assert "test/rgb/ (1), validation/ (1)" in parts
    assert beside == "1 images beside the used ones have no frame and are left out: more.png"


def test_who_names_the_folder_of_the_poses_alone_is_told_of_the_photos_beside_it(tmp_path):
    document = nerfstudio_scene(tmp_path / "nerfstudio")
    (tmp_path / "nerfstudio/images").rename(tmp_path / "resized_images")
    save(tmp_path / "nerfstudio", document)
    with pytest.raises(InputError) as caught:
        read_dataset(tmp_path / "nerfstudio")
    assert (caught.value.code, caught.value.where) == ("image_missing", "transforms.json frames[0].file_path")
    assert "lies in resized_images, beside nerfstudio: give the folder above both" in caught.value.hint


def test_no_photo_above_the_folder_of_an_upload_is_looked_at(tmp_path):
    document = nerfstudio_scene(tmp_path / "of_another")
    (tmp_path / "of_another/images").rename(tmp_path / "images")
    place = tmp_path / "upload"
    place.mkdir()
    file = save(place, document)
    with pytest.raises(InputError) as caught:
        read_dataset(file, place)
    assert caught.value.code == "image_missing"
    assert "beside" not in caught.value.hint


def test_a_result_that_lies_in_the_set_is_not_taken_for_its_poses(tmp_path):
    write_images(tmp_path)
    colmap_set(tmp_path / "out")
    for name in ("report.json", "config.json"):
        (tmp_path / "out" / name).write_text("{}")
    assert look_into(tmp_path).format is None
