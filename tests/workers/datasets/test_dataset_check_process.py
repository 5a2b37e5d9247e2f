"""The check of a dataset: every form is read inside its folder, and what was found is counted."""

from __future__ import annotations

from pathlib import Path
from typing import Any
from unittest.mock import ANY

import numpy as np
import pytest
from PIL import Image

from biresnerf.data.formats.read_dataset import read_dataset
from biresnerf.data.photos.masks import load_mask
from biresnerf.errors import InputError
from biresnerf.forecast.rates import UNKNOWN, remember_rates
from biresnerf.forecast.run_forecast import RATES
from biresnerf.machine import usable_cores
from biresnerf.options.presets import PRESETS
from biresnerf.wire.datasets import CheckedPhoto, CheckReport, PhotoList
from tests.data.formats.simple import trajectories
from tests.data.given_poses.views import around, written
from tests.data.scenes import nerfstudio_scene, save, write_image
from workers.datasets import dataset_check_process
from workers.records import FIRST_PHOTO, PHOTO_LIST, PHOTO_SHEET, shown_folder

TIMES = dict.fromkeys(PRESETS, ANY)


def check(folder: Path) -> dict[str, Any]:
    return dataset_check_process.check(folder, shown_folder(folder))


def test_what_was_found_is_counted(tmp_path: Path) -> None:
    trajectories.colmap_set(tmp_path, registered=3)
    write_image(tmp_path / "masks/a.png.png", mode="L")
    assert check(tmp_path) == {
        "images": 4, "with_pose": 3, "without_pose": 1, "poses": "partial", "cameras": 1,
        "camera_models": ["PINHOLE"], "intrinsics": ["given"], "format": "colmap", "masks": 1, "transparency": False,
        "warnings": ["1 of 4 images have no pose yet: d.png", "masks were found for 1 of 4 images"],
        "pose_question": None, "expected_s": TIMES, "preset": "fast",
    }  # fmt: skip


def test_what_pages_show_is_left_beside_the_set(tmp_path: Path) -> None:
    folder = tmp_path / "set"
    trajectories.colmap_set(folder, registered=3)
    write_image(folder / "masks/a.png.png", mode="L")
    check(folder)
    shown = shown_folder(folder)
    found = PhotoList.model_validate_json((shown / PHOTO_LIST).read_bytes())
    dataset = read_dataset(folder)
    assert [photo.name for photo in found.photos] == list(dataset.names)
    assert [photo.masked for photo in found.photos] == [True, False, False, False]
    assert found.photos[3].world_from_cam is None
    for photo, frame in zip(found.photos[:3], dataset.frames, strict=False):
        np.testing.assert_allclose(photo.world_from_cam, frame.world_from_cam[:3])
    (lens,) = dataset.cameras
    assert [(one.model, one.params) for one in found.cameras] == [(lens.model, tuple(lens.params))]
    assert found.sheet is not None
    wide, high = found.sheet.cell_width, found.sheet.cell_height
    photos = [np.asarray(Image.open(frame.path).convert("L"), float) for frame in dataset.frames]
    sheet = Image.open(shown / PHOTO_SHEET).convert("L")
    assert sheet.size == (found.sheet.columns * wide, -(-4 // found.sheet.columns) * high)
    for index in range(4):
        row, column = divmod(index, found.sheet.columns)
        cell = sheet.crop((column * wide, row * high, (column + 1) * wide, (row + 1) * high))
        apart = [np.abs(np.asarray(cell, float) - photo).mean() for photo in photos]
        assert np.argmin(apart) == index
    with Image.open(shown / FIRST_PHOTO) as first, Image.open(dataset.frames[0].path) as photo:
        assert first.size == photo.size


def test_poses_that_seem_to_be_inverted_are_asked_about_and_shown_both_ways(tmp_path: Path) -> None:
    turn = np.diag([1.0, -1, -1, 1])
    poses = around()
    written(tmp_path / "set", np.linalg.inv(poses @ turn) @ turn, poses)
    report = CheckReport.model_validate(check(tmp_path / "set"))
    assert report.pose_question is not None
    assert report.pose_question.given_poses == ("inverted",)
    found = PhotoList.model_validate_json((shown_folder(tmp_path / "set") / PHOTO_LIST).read_bytes())
    dataset = read_dataset(tmp_path / "set")
    for photo, pose, frame in zip(found.photos, poses, dataset.frames, strict=True):
        np.testing.assert_allclose(photo.world_from_cam, frame.world_from_cam[:3])
        np.testing.assert_allclose(photo.read_as_asked, pose[:3], atol=1e-9)


def test_copies_of_a_photo_are_named(tmp_path: Path) -> None:
    trajectories.write_images(tmp_path)
    (tmp_path / "images/copy.png").write_bytes((tmp_path / "images/a.png").read_bytes())
    assert any("copy.png (of " in text for text in check(tmp_path)["warnings"])


def test_the_expected_time_is_that_of_the_latest_machine(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    trajectories.colmap_set(tmp_path / "set")
    general = check(tmp_path / "set")["expected_s"]
    assert 0 < general["fast"][0] < general["fast"][1] < general["balanced"][1] < general["quality"][1]
    cores = usable_cores()
    remember_rates("cuda", 8, {unit: rate / 1000 for unit, rate in RATES.items()})
    remember_rates("cpu", cores, {unit: 2 * rate / cores for unit, rate in RATES.items()})
    slower = check(tmp_path / "set")["expected_s"]
    for preset, (least_s, most_s) in general.items():
        usual_s = least_s / UNKNOWN[0]
        assert most_s == pytest.approx(UNKNOWN[1] * usual_s)
        assert slower[preset] == pytest.approx([2 * usual_s, 2 * usual_s]), "it was measured here"
    remember_rates("cuda", 8, {unit: rate / 1000 for unit, rate in RATES.items()})
    assert check(tmp_path / "set")["expected_s"]["fast"][1] < general["fast"][0]


def test_images_alone_are_decoded_and_have_no_pose(tmp_path: Path) -> None:
    trajectories.write_images(tmp_path)
    report = check(tmp_path)
    assert (report["poses"], report["without_pose"], report["intrinsics"]) == ("missing", 4, ["guessed"])
    whole = (tmp_path / "images/a.png").read_bytes()
    (tmp_path / "images/a.png").write_bytes(whole[: len(whole) // 2])
    with pytest.raises(InputError) as caught:
        check(tmp_path)
    assert caught.value.code == "image_truncated"


FORMS = ["transforms", "colmap", "llff", "tum", "bundler", "metashape", "images"]


def write_set(folder: Path, form: str) -> None:
    """A set whose first photo is images/a.png."""
    folder.mkdir()
    if form == "transforms":
        document = nerfstudio_scene(folder)
        write_image(folder / "images/a.png")
        document["frames"][0]["file_path"] = "images/a.png"
        save(folder, document)
    elif form == "colmap":
        trajectories.colmap_set(folder)
    elif form == "llff":
        trajectories.llff_set(folder)
    elif form == "tum":
        trajectories.tum_set(folder, ["0", "1", "2", "3"])
    elif form == "bundler":
        trajectories.bundler_set(folder)
    else:
        trajectories.write_images(folder)
    if form == "metashape":
        (folder / "cameras.xml").write_text(trajectories.metashape_xml())


@pytest.mark.parametrize("form", FORMS)
def test_a_link_out_of_the_folder_is_refused_in_every_form(tmp_path: Path, form: str) -> None:
    folder = tmp_path / "set"
    write_image(tmp_path / "secret.png")
    write_set(folder, form)
    (folder / "images/a.png").unlink()
    (folder / "images/a.png").symlink_to(tmp_path / "secret.png")
    with pytest.raises(InputError) as caught:
        check(folder)
    assert caught.value.code == "unsafe_path"


@pytest.mark.parametrize("form", FORMS)
def test_a_mask_at_the_place_that_is_named_is_read_in_every_form(tmp_path: Path, form: str) -> None:
    folder = tmp_path / "set"
    write_set(folder, form)
    before = photo_a(folder)
    assert (before.path, before.masked) == ("images/a.png", False)
    assert before.mask is not None
    with Image.open(folder / "images/a.png") as photo:
        away = np.zeros((photo.height, photo.width), dtype=np.uint8)
    away[:, :7] = 255
    Image.fromarray(away if before.mask.inverted else 255 - away).save(folder / before.mask.path)
    assert check(folder)["masks"] == 1
    after = photo_a(folder)
    assert (after.masked, after.mask) == (True, before.mask)
    dataset = read_dataset(folder)
    index = next(i for i, frame in enumerate(dataset.frames) if frame.path.name == "a.png")
    counts = load_mask(dataset.frames[index], dataset.camera_of(index))
    np.testing.assert_array_equal(counts, away == 0)


def photo_a(folder: Path) -> CheckedPhoto:
    check(folder)
    listed = PhotoList.model_validate_json((shown_folder(folder) / PHOTO_LIST).read_bytes())
    return next(photo for photo in listed.photos if photo.path and photo.path.endswith("a.png"))
