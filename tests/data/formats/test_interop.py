"""Small cases of other programs' sets that went wrong once: each is read correctly, or refused by name."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from PIL import Image

from biresnerf.data.formats.read_dataset import read_dataset
from biresnerf.errors import InputError
from tests.data.formats.posed_sets import write_plain_photos
from tests.data.test_real_sets import ROOT

CASES = ROOT / "interop"
if not CASES.is_dir():
    pytest.skip(
        "no image set interop: set BIRESNERF_TEST_DATA to the folder that holds it", allow_module_level=True
    )

# The case: format, frames, frames with a pose, and what a warning says of it.
READ = {
    "05_poses_silently_ignored/sdfstudio": ("sdfstudio", 8, 8, None),
    "05_poses_silently_ignored/tnt": ("tanks-and-temples", 8, 8, "in the order of their names"),
    "06_says_no_images_where_there_are/bop": ("bop", 8, 0, "4 of 12 images not found"),
    "06_says_no_images_where_there_are/record3d": ("record3d", 6, 6, None),
    "05_poses_silently_ignored/rc_csv": ("realitycapture", 8, 8, None),
    "06_says_no_images_where_there_are/dtu": ("neus", 8, 8, "by their numbers"),
    "05_poses_silently_ignored/7scenes": ("matrix-files", 8, 8, None),
    "06_says_no_images_where_there_are/scannet": ("matrix-files", 8, 8, "focal length"),
    "02_own_instant_ngp_folder_ignored": ("nerfstudio", 4, 4, None),
    "03_list_rd_not_read": ("bundler", 10, 10, None),
    "04_bundler_list_windows_paths": ("bundler", 10, 10, "kermit001.jpg"),
    "08_nfc_nfd": ("nerfstudio", 4, 4, "Unicode form"),
    "09_case_of_extension": ("nerfstudio", 4, 4, "whatever its case"),
    "10_paths_of_another_machine": ("nerfstudio", 4, 4, "parts of their path"),
    "11_per_frame_size_shared_focal": ("nerfstudio", 6, 6, None),
    "16_kitti_own_layout": ("kitti", 50, 50, "in the order of the images' names"),
    "18_cam_folders": ("images", 6, 0, None),
    "21_llff_images_folder": ("blender", 60, 60, None),
    "22_json_comment_xfov": ("nerfstudio", 4, 4, "x_fov was taken"),
    "23_tum_header_without_hash": ("tum", 40, 39, "by time"),
}
REFUSED = {
    "05_poses_silently_ignored/mvsnet": ("poses_coincide", "one point"),
    "06_says_no_images_where_there_are/evo": ("pose_file_invalid", "how the camera sits on the body"),
    "06_says_no_images_where_there_are/nerfies": ("poses_coincide", "one point"),
    "06_says_no_images_where_there_are/polycam": ("poses_coincide", "one point"),
    "05_poses_silently_ignored/rc_xmp": ("poses_coincide", "one point"),
    "05_poses_silently_ignored/meshroom": ("image_missing", "images not found"),
    "05_poses_silently_ignored/openmvg": ("image_missing", "images not found"),
    "06_says_no_images_where_there_are/nsvf": ("poses_coincide", "one point"),
    "05_poses_silently_ignored/3dgs_cameras": ("image_missing", "14 of 14 images not found"),
    "05_poses_silently_ignored/opensfm": ("image_missing", "19 of 19 images not found"),
    "07_heic_beside_jpg": ("not_an_image", "not an image"),  # of HEIC they have the head only
    "19_model_without_points": ("no_images", "there are poses, but no photo"),
    "20_blender_dialect_to_nerfstudio": ("image_missing", "./train/r_0"),
}


@pytest.mark.parametrize("name", READ)
def test_a_case_is_read_and_what_was_done_with_it_is_said(name):
    dialect, frames, posed, said = READ[name]
    dataset = read_dataset(CASES / name)
    assert (dataset.source.dialect, len(dataset), int(dataset.posed.sum())) == (dialect, frames, posed)
    if said is not None:
        assert any(said in text for text in dataset.warnings), dataset.warnings


@pytest.mark.parametrize("name", REFUSED)
def test_a_case_that_cannot_be_read_is_refused_by_its_name(name):
    code, said = REFUSED[name]
    with pytest.raises(InputError, match=r"photo|found|point|camera|IMG_0.HEIC") as caught:
        read_dataset(CASES / name)
    assert caught.value.code == code
    assert said in caught.value.detail
    assert caught.value.hint.endswith(".")


def test_no_case_is_without_an_expectation():
    cases = {path.name for path in CASES.iterdir() if path.is_dir()}
    for group in ("05_poses_silently_ignored", "06_says_no_images_where_there_are"):
        cases = cases - {group} | {f"{group}/{path.name}" for path in (CASES / group).iterdir()}
    tests = "".join(path.read_text() for path in Path(__file__).parents[2].rglob("test_*.py"))
    assert [case for case in sorted(cases) if case not in tests] == []


def test_a_metashape_export_with_skew_is_read_and_its_photos_are_straightened(tmp_path):
    case = CASES / "12_metashape_b2"
    shutil.copy(case / "cameras.xml", tmp_path)
    tree = ElementTree.parse(case / "cameras.xml")
    cameras = {one.get("label"): one for one in tree.iter("camera")}
    sensors = {one.get("id"): one.find("calibration[@class='adjusted']") for one in tree.iter("sensor")}
    write_plain_photos(tmp_path / "images", [f"{label}.jpg" for label in cameras], (648, 432))
    dataset = read_dataset(tmp_path)
    posed = [frame for frame in dataset.frames if frame.world_from_cam is not None]
    assert len(posed) == sum(one.find("transform") is not None for one in cameras.values()) > 3
    for frame in posed:
        camera = cameras[frame.name.removesuffix(".jpg")]
        given = np.array(camera.findtext("transform").split(), dtype=float)
        np.testing.assert_allclose(frame.world_from_cam, given.reshape(4, 4), atol=1e-12)
        f, b2 = (float(sensors[camera.get("sensor_id")].findtext(name, "0")) for name in ("f", "b2"))
        shear = b2 / f if abs(b2 / f) * 3456 / 2 > 0.5 else 0.0
        assert dataset.cameras[frame.camera].shear == pytest.approx(shear)
    skewed = sum(dataset.camera_of(index).shear != 0 for index in range(len(dataset)))
    assert any(f"{skewed} photos were taken with skew" in text for text in dataset.warnings)


def test_photos_that_are_links_are_not_said_to_be_unused(tmp_path):
    case = CASES / "01_symlink_false_warning"
    shutil.copytree(case / "src", tmp_path / "src", copy_function=shutil.copyfile)
    (tmp_path / "images").mkdir()
    for path in (tmp_path / "src").iterdir():
        (tmp_path / "images" / path.name).symlink_to(path)
    shutil.copyfile(case / "transforms.json", tmp_path / "transforms.json")
    assert read_dataset(tmp_path).warnings == ()


def test_a_bundlers_list_of_undistorted_photos_gives_each_camera_its_photo():
    case = CASES / "03_list_rd_not_read"
    dataset = read_dataset(case)
    numbers = [line.split() for line in (case / "bundle.rd.out").read_text().splitlines()[1:]]
    for index, frame in enumerate(dataset.frames):
        assert frame.name == (case / "list.rd.txt").read_text().splitlines()[index].split()[0]
        block = np.array(numbers[1 + 5 * index + 1 : 1 + 5 * index + 5], dtype=float)
        centre = -block[:3].T @ block[3]
        np.testing.assert_allclose(frame.world_from_cam[:3, 3], centre, atol=1e-6)
        assert dataset.camera_of(index).full().fx == float(numbers[1 + 5 * index][0])


def test_a_video_is_read_by_its_frames(tmp_path):
    shutil.copyfile(CASES / "17_mp4/v.mp4", tmp_path / "v.mp4")
    dataset = read_dataset(tmp_path)
    assert len(dataset) == 20
    assert dataset.names[:2] == ("video_frames/v_mp4/00m00s000.jpg", "video_frames/v_mp4/00m00s100.jpg")


def test_the_fox_is_read_without_the_photos_that_its_file_names_and_its_folder_lacks(tmp_path):
    (tmp_path / "images").symlink_to(ROOT / "fox" / "images")
    shutil.copyfile(CASES / "13_fox_17_missing/transforms.json", tmp_path / "transforms.json")
    dataset = read_dataset(tmp_path)
    assert len(dataset) == 50
    assert any("17 of 67 images not found" in text for text in dataset.warnings)
    with pytest.raises(InputError, match="17 of 67"):
        read_dataset(tmp_path, strict=True)


def test_a_matrix_with_a_last_row_of_0_0_0_s_is_divided_by_s(tmp_path):
    case = CASES / "14_last_row_scaled"
    document = json.loads((case / "transforms.json").read_text())
    document["frames"] = document["frames"][:5]
    for index, row in enumerate(document["frames"]):
        path = tmp_path / row["file_path"]
        path.parent.mkdir(exist_ok=True)
        Image.new("L", (int(document["w"]), int(document["h"])), index).save(path)
    (tmp_path / "transforms.json").write_text(json.dumps(document))
    dataset = read_dataset(tmp_path)
    for row, pose in zip(document["frames"], dataset.world_from_cam, strict=True):
        matrix = np.array(row["transform_matrix"])
        np.testing.assert_allclose(pose[:3, 3], matrix[:3, 3] / matrix[3, 3])


def test_a_lens_that_folds_the_image_is_refused_by_its_coefficient(tmp_path):
    case = CASES / "15_lens_folds"
    document = json.loads((case / "transforms_train.json").read_text())
    for index, row in enumerate(document["frames"]):
        path = tmp_path / row["file_path"]
        path.parent.mkdir(exist_ok=True)
        Image.new("L", (int(document["w"]), int(document["h"])), index).save(path)
    shutil.copyfile(case / "transforms_train.json", tmp_path / "transforms_train.json")
    with pytest.raises(InputError) as caught:
        read_dataset(tmp_path)
    assert caught.value.code == "intrinsics_invalid"
    assert "k1" in caught.value.where
