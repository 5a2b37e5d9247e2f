"""Folders: what is read of them, and what is reported instead of silently ignored."""

from __future__ import annotations

import shutil

import pytest

from biresnerf.data.formats.folder import look_into
from biresnerf.data.formats.read_dataset import read_dataset
from biresnerf.errors import InputError
from tests.data.formats.simple import trajectories
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
    assert contents.poses is None
    assert [path.name for path in contents.images] == ["0.png", "1.png", "2.png"]
    assert contents.root == tmp_path


def test_a_folder_without_images_is_refused(tmp_path):
    (tmp_path / "notes.txt").touch()
    with pytest.raises(InputError) as caught:
        read_dataset(tmp_path)
    assert_complete(caught.value, "no_images", tmp_path.name)


FORMS = {
    "transforms.json": "transforms",
    "sparse/0": "colmap",
    "colmap/sparse/0": "colmap",
    "poses_bounds.npy": "llff",
    "bundle.out": "bundler",
    "cameras.xml": "metashape",
    "trajectory.txt": "trajectory",
}


def test_the_first_form_in_the_order_is_read_and_the_others_are_said(tmp_path):
    present = list(FORMS)
    for name in present:
        path = tmp_path / name
        if FORMS[name] == "colmap":
            path.mkdir(parents=True)
            (path / "cameras.bin").touch()
            (path / "images.bin").touch()
        else:
            path.write_text("<document><chunk>" if path.suffix == ".xml" else "")
    write_image(tmp_path / "images/0.png")
    while present:
        contents = look_into(tmp_path)
        assert contents.format == FORMS[present[0]]
        assert contents.root == tmp_path
        if len(present) > 1:
            were = "were not" if len(present) > 2 else "was not"
            assert contents.notes == (f"{present[0]} was read and {', '.join(present[1:])} {were}",)
        path = tmp_path / present.pop(0)
        shutil.rmtree(path) if path.is_dir() else path.unlink()
    assert look_into(tmp_path).format is None


@pytest.mark.parametrize("name", ["poses.bin", "audio.mp3", "scene.ply"])
def test_a_file_in_no_form_that_is_read_is_refused(tmp_path, name):
    (tmp_path / name).touch()
    with pytest.raises(InputError) as caught:
        read_dataset(tmp_path / name)
    assert_complete(caught.value, "input_unsupported", name)


def test_poses_find_photos_whose_numbers_have_other_zeros(tmp_path):
    names = ("frame_0008.png", "frame_0009.png", "frame_0010.png", "frame_0011.png")
    trajectories.colmap_set(tmp_path, names)
    for name in names:
        (tmp_path / "images" / name).rename(
            tmp_path / "images" / name.replace("_00", "_0").replace("_00", "_").replace("_0", "_")
        )
    dataset = read_dataset(tmp_path)
    assert [frame.path.stem for frame in dataset.frames] == ["frame_8", "frame_9", "frame_10", "frame_11"]
    trajectories.assert_at_truth(dataset)
    assert any("numbers compared as numbers" in text for text in dataset.warnings)


@pytest.mark.parametrize("folders", [("rgb",), ("color", "other"), ("image_2", "image_3"), ("cam0", "cam1")])
def test_photos_alone_are_found_where_people_keep_them_and_other_folders_are_said(tmp_path, folders):
    for folder in folders:
        for index in range(3):
            write_image(tmp_path / folder / f"data/{index}.png", index)
            write_image(tmp_path / "depth" / f"{index}.png", index)
    contents = look_into(tmp_path)
    every = folders[0].startswith(("cam", "image_"))
    taken = folders if every else folders[:1]
    assert {path.relative_to(tmp_path).parts[0] for path in contents.images} == set(taken)
    assert contents.notes == (
        ("photos in other folders are left out: other/ (3)",) if "other" in folders else ()
    )


def test_what_is_no_photo_that_is_read_is_counted_by_its_kind(tmp_path):
    for name in ("a.gif", "b.gif"):
        (tmp_path / name).touch()
    with pytest.raises(InputError) as caught:
        read_dataset(tmp_path)
    assert_complete(caught.value, "no_images", tmp_path.name)
    assert "2 GIF (a.gif, b.gif)" in caught.value.detail
    for index in range(3):
        write_image(tmp_path / f"{index}.jpg", index)
    assert any("2 GIF files are not read" in text for text in read_dataset(tmp_path).warnings)
