"""The images and masks that a transforms.json names: how they are found, and what is noted about them."""

from __future__ import annotations

import os

import pytest
from PIL import Image

from biresnerf.data.formats.read_dataset import read_dataset
from tests.data.scenes import (
    HEIGHT,
    WIDTH,
    nerfstudio_scene,
    save,
    write_image,
)


@pytest.mark.parametrize("suffix", [".png", ".jpg", ".JPG", ".jpeg", ".webp", ".tif"])
def test_images_are_found_without_their_extension(tmp_path, suffix):
    document = nerfstudio_scene(tmp_path)
    for index, row in enumerate(document["frames"]):
        os.remove(tmp_path / row["file_path"])
        write_image(tmp_path / f"images/{index:03}{suffix}", index)
        row["file_path"] = f"images/{index:03}"
    dataset = read_dataset(save(tmp_path, document))
    assert dataset.frames[0].path.suffix == suffix


def test_names_with_spaces_accents_backslashes_and_dots_are_found(tmp_path):
    document = nerfstudio_scene(tmp_path)
    names = ["images/a b.jpg", "images/Übersicht é.jpg", "images/v1.2.jpg", "../elsewhere/out.jpg"]
    for name, row in zip(names, document["frames"], strict=True):
        write_image(tmp_path / name)
        row["file_path"] = name
    document["frames"][0]["file_path"] = "images\\a b.jpg"
    dataset = read_dataset(save(tmp_path, document))
    assert dataset.names[0] == "images\\a b.jpg"
    assert dataset.file_names == (*names[:3], "../elsewhere/out.jpg")


def test_an_exif_orientation_is_said_and_left_alone(tmp_path):
    document = nerfstudio_scene(tmp_path)
    exif = Image.Exif()
    exif[0x0112] = 6
    Image.new("RGB", (WIDTH, HEIGHT)).save(tmp_path / "images/002.jpg", exif=exif)
    dataset = read_dataset(save(tmp_path, document))
    assert dataset.camera_of(2).width == WIDTH
    assert "EXIF" in dataset.warnings[0]
    assert "images/002.jpg" in dataset.warnings[0]


def test_images_without_frame_are_left_out_and_said(tmp_path):
    document = nerfstudio_scene(tmp_path, count=5)
    del document["frames"][4]
    dataset = read_dataset(save(tmp_path, document))
    assert len(dataset) == 4
    assert any("004.jpg" in text for text in dataset.warnings)


@pytest.mark.parametrize("declared", [True, False])
@pytest.mark.parametrize("extension", ["", ".jpg"])
def test_photos_that_are_there_in_smaller_copies_alone_are_read_with_their_lens_scaled(
    tmp_path, declared, extension
):
    document = nerfstudio_scene(tmp_path)
    for key, value in {
        "w": 8 * WIDTH,
        "h": 8 * HEIGHT,
        "fl_x": 144.0,
        "fl_y": 148.0,
        "cx": 82.0,
        "cy": 62.0,
    }.items():
        document[key] = value
    if not declared:
        del document["w"], document["h"]
    for frame in document["frames"]:
        frame["file_path"] = "./" + frame["file_path"].removesuffix(".jpg") + extension
    (tmp_path / "images").rename(tmp_path / "images_8")
    (tmp_path / "images_16").mkdir()
    for path in (tmp_path / "images_8").iterdir():
        Image.open(path).resize((WIDTH // 2, HEIGHT // 2)).save(tmp_path / "images_16" / path.name)
    dataset = read_dataset(save(tmp_path, document))
    assert [frame.path.parent.name for frame in dataset.frames] == ["images_8"] * 4
    camera = dataset.cameras[0]
    assert (camera.width, camera.height) == (WIDTH, HEIGHT)
    assert camera.full()[:4] == pytest.approx((18.0, 18.5, 10.25, 7.75))
    assert any("in a folder of smaller copies" in text for text in dataset.warnings)


def test_masks_are_found_by_their_path_or_as_instant_ngp_names_them_which_means_the_opposite(tmp_path):
    document = nerfstudio_scene(tmp_path)
    for name in ("masks/000.png", "images/dynamic_mask_001.png", "images/dynamic_mask_000.png"):
        write_image(tmp_path / name, mode="L")
    document["frames"][0]["mask_path"] = "masks/000.png"
    dataset = read_dataset(save(tmp_path, document))
    assert [(f.mask, f.mask_inverted) for f in dataset.frames] == [
        (tmp_path / "masks/000.png", False),
        (tmp_path / "images/dynamic_mask_001.png", True),
        (None, False),
        (None, False),
    ]
    assert dataset.warnings == ("masks were found for 2 of 4 images",)
