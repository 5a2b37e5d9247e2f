"""Files beside photos that are none: maps of them, masks, small copies, unsupported kinds."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from biresnerf.data.formats.read_dataset import read_dataset
from biresnerf.data.photos.image_files import images_called
from biresnerf.data.photos.photo_folders import images_in
from biresnerf.errors import InputError
from tests.data.formats.simple import trajectories
from tests.data.scenes import nerfstudio_scene, save


def _pictures(folder: Path, names: list[str], mode: str = "RGB") -> None:
    folder.mkdir(exist_ok=True)
    for name in names:
        Image.new(mode, (30, 20)).save(folder / name)


@pytest.mark.parametrize(
    ("photo", "others"),
    [
        ("r_{}.png", ["r_{}_depth_0001.png", "r_{}_normal_0001.png"]),
        ("{}.JPG", ["{}_mask.JPG", "{}.JPG.mask.png", "{}_segmentation.png"]),
        ("frame_0000{}.jpg", ["depth_0000{}.png", "conf_0000{}.png", "thumb_0000{}.jpg"]),
        ("DSC{}.jpg", ["DSC{} thumbnail.jpg", "DSC{}-disparity.tif"]),
    ],
)
def test_maps_and_small_copies_of_photos_are_left_out_and_counted(tmp_path, photo, others):
    photos = [photo.format(number) for number in range(1, 5)]
    maps = [other.format(number) for number in range(1, 5) for other in others]
    _pictures(tmp_path, photos + maps)
    dataset = read_dataset(tmp_path)
    assert list(dataset.names) == photos
    masks = sum(frame.mask is not None for frame in dataset.frames)
    counted = [text for text in dataset.warnings if "called as maps" in text]
    assert sum(int(text.split()[0]) for text in counted) + masks in (len(maps), len(maps) - 4)


@pytest.mark.parametrize(
    "names",
    [
        [f"mask_{number}.jpg" for number in range(4)],  # photos of a mask
        ["normal_view.jpg", "side.jpg", "top.jpg"],
        ["label_1.jpg", "label_2.jpg", "stand_3.jpg"],
        ["unmasked1.jpg", "1.jpg", "2.jpg"],
    ],
)
def test_photos_of_things_that_are_called_so_stay_photos(tmp_path, names):
    _pictures(tmp_path, names)
    assert {path.name for path in images_in(tmp_path)} == set(names)


def test_a_grey_picture_beside_a_photo_of_its_name_is_not_taken_for_it(tmp_path):
    _pictures(tmp_path, ["1.jpg", "2.png", "3.jpg", "3.png", "4.jpg"])
    _pictures(tmp_path, ["1.png", "2.jpg", "4.png"], "L")
    Image.fromarray(np.zeros((20, 30), np.uint16)).save(tmp_path / "4.png")
    assert [path.name for path in images_in(tmp_path)] == ["1.jpg", "2.png", "3.jpg", "3.png", "4.jpg"]
    for name, file in (("1", "1.jpg"), ("2", "2.png"), ("3", "3.jpg"), ("4", "4.jpg")):
        assert images_called(tmp_path, name)[0] == tmp_path / file


def test_a_mask_saved_in_colours_is_no_photo_either(tmp_path):
    noise = np.random.default_rng(0).integers(0, 256, (20, 30, 3), dtype=np.uint8)
    for name in ("1.jpg", "2.jpg", "3.jpg", "3.png"):
        Image.fromarray(noise).save(tmp_path / name)
    for name, mode in (("1.png", "RGB"), ("2.png", "RGBA")):
        Image.fromarray(noise[..., 0]).convert(mode).save(tmp_path / name)
    assert [path.name for path in images_in(tmp_path)] == ["1.jpg", "2.jpg", "3.jpg", "3.png"]


@pytest.mark.parametrize("form", ["colmap", "metashape"])
def test_poses_that_name_the_grey_one_of_two_pictures_get_it(tmp_path, form):
    trajectories.write_set(form, tmp_path)
    for path in list((tmp_path / "images").iterdir()):
        picture = Image.open(path)
        picture.convert("L").save(path)
        Image.merge(
            "RGB", (picture.convert("L"), Image.new("L", picture.size), Image.new("L", picture.size))
        ).save(path.with_suffix(".jpg"))
    suffix = ".png" if form == "colmap" else ".jpg"  # Metashape's labels have none
    assert [frame.path.name for frame in read_dataset(tmp_path).frames] == [
        f"{one}{suffix}" for one in "abcd"
    ]


def test_poses_that_name_a_picture_called_as_a_map_get_it(tmp_path):
    names = ("stand_1.png", "mask_1.png", "stand_2.png", "mask_2.png")
    trajectories.colmap_set(tmp_path, names)
    dataset = read_dataset(tmp_path)
    assert {frame.path.name for frame in dataset.frames} == set(names)
    assert dataset.posed.all()


def test_a_name_without_extension_that_fits_two_files_is_said(tmp_path):
    document = nerfstudio_scene(tmp_path)
    for frame in document["frames"]:
        frame["file_path"] = frame["file_path"].removesuffix(".jpg")
    first = document["frames"][0]["file_path"]
    Image.open(tmp_path / f"{first}.jpg").convert("L").save(tmp_path / f"{first}.png")
    dataset = read_dataset(save(tmp_path, document))
    assert dataset.frames[0].path.suffix == ".jpg"
    assert any("000.jpg (not 000.png)" in text for text in dataset.warnings)


def test_files_of_kinds_that_are_not_read_are_named(tmp_path):
    (tmp_path / "images").mkdir()
    for number in range(3):
        (tmp_path / f"images/{number}.jp2").write_bytes(b"\0\0\0\x0cjP  ")
    with pytest.raises(InputError, match=r"3 JPEG 2000 \(images/0.jp2") as caught:
        read_dataset(tmp_path)
    assert caught.value.code == "no_images"
    _pictures(tmp_path / "images", ["a.png", "b.png", "c.png"])
    assert "3 JPEG 2000 files are not read and left out" in " ".join(read_dataset(tmp_path).warnings)


def test_smaller_copies_of_photos_count_once(tmp_path):
    for folder in ("images_8", "images_4", "images_16"):
        _pictures(tmp_path / folder, ["1.jpg", "2.jpg", "3.jpg"])
    assert set(read_dataset(tmp_path).names) == {f"images_4/{number}.jpg" for number in (1, 2, 3)}


def test_a_folder_of_files_that_nobody_knows_is_said_with_their_kinds(tmp_path):
    (tmp_path / "images").mkdir()
    (tmp_path / "images/1.xyz").touch()
    (tmp_path / "images/2.xyz").touch()
    (tmp_path / "raw").mkdir()
    (tmp_path / "raw/README").touch()
    with pytest.raises(InputError, match=r"it holds images/ \(2 .xyz\), raw/ \(1 no extension\)"):
        read_dataset(tmp_path)
