"""The check of a dataset: every form is read inside its folder, and what was found is counted."""

from __future__ import annotations

from pathlib import Path

import pytest

from biresnerf.errors import InputError
from tests.data.formats.simple import trajectories
from tests.data.scenes import nerfstudio_scene, save, write_image
from workers.datasets.dataset_check_process import check


def test_what_was_found_is_counted(tmp_path: Path) -> None:
    trajectories.colmap_set(tmp_path, registered=3)
    write_image(tmp_path / "masks/a.png.png", mode="L")
    assert check(tmp_path) == {
        "images": 4, "with_pose": 3, "without_pose": 1, "poses": "partial", "cameras": 1,
        "camera_models": ["PINHOLE"], "intrinsics": ["given"], "format": "colmap", "masks": 1, "transparency": False,
        "warnings": ["1 of 4 images have no pose yet: d.png", "masks were found for 1 of 4 images"],
    }  # fmt: skip


def test_images_alone_are_decoded_and_have_no_pose(tmp_path: Path) -> None:
    trajectories.write_images(tmp_path)
    report = check(tmp_path)
    assert (report["poses"], report["without_pose"], report["intrinsics"]) == ("missing", 4, ["guessed"])
    whole = (tmp_path / "images/a.png").read_bytes()
    (tmp_path / "images/a.png").write_bytes(whole[: len(whole) // 2])
    with pytest.raises(InputError) as caught:
        check(tmp_path)
    assert caught.value.code == "image_truncated"


@pytest.mark.parametrize("form", ["transforms", "colmap", "llff", "tum", "bundler", "metashape", "images"])
def test_a_link_out_of_the_folder_is_refused_in_every_form(tmp_path: Path, form: str) -> None:
    folder = tmp_path / "set"
    folder.mkdir()
    write_image(tmp_path / "secret.png")
    if form == "transforms":
        document = nerfstudio_scene(folder)
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
    (folder / "images/a.png").unlink(missing_ok=True)
    (folder / "images/a.png").symlink_to(tmp_path / "secret.png")
    with pytest.raises(InputError) as caught:
        check(folder)
    assert caught.value.code == "unsafe_path"
