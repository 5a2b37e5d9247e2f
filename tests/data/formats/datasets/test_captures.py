"""Captures and benchmarks, each written by its program's rules: poses, lenses and names are read back.

Every case writes the same five poses and lenses, and reads them back with the library's own projection.
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from biresnerf.data.formats.read_dataset import read_dataset, read_poses
from biresnerf.errors import InputError
from tests.data.formats.datasets.captures import (
    PINHOLE,
    bop,
    dump,
    euroc,
    mvsnet,
    nerfies,
    polycam,
    realestate10k,
    record3d,
    scanner_app,
    sdfstudio,
    tanks_and_temples,
)
from tests.data.formats.posed_sets import assert_reads_as, write_photos
from tests.data.scenes import assert_complete

CASES = {
    "record3d": (record3d, "metadata.json"),
    "polycam": (polycam, "keyframes/corrected_cameras/0.json"),
    "mvsnet": (mvsnet, "cams/00000000_cam.txt"),
    "bop": (bop, "scene_camera.json"),
    "sdfstudio": (sdfstudio, "meta_data.json"),
    "nerfies": (nerfies, "camera/000000.json"),
    "3d-scanner-app": (scanner_app, "frame_00000.json"),
    "realestate10k": (realestate10k, "000c3ab189999a83.txt"),
    "euroc": (euroc, "mav0/state_groundtruth_estimate0/data.csv"),
}
VARIANTS = {
    "record3d": [
        lambda folder: record3d(folder, per_frame=False),
        lambda folder: record3d(folder, "metadata", "rgbd/{}.jpg"),
    ],
    "polycam": [
        lambda folder: polycam(folder, "corrected_cameras", "corrected_images/{}.jpg"),
        lambda folder: polycam(folder, "keyframes/cameras", "keyframes/images/{}.jpg"),
        lambda folder: polycam(folder, size=()),
    ],
    "realestate10k": [lambda folder: realestate10k(folder, times=False)],
    "nerfies": [lambda folder: nerfies(folder, "tangential")],
    "euroc": [
        lambda folder: euroc(folder, "equidistant"),
        lambda folder: euroc(folder, above=""),
    ],
}


@pytest.mark.parametrize("form", CASES)
def test_a_set_is_read_from_its_folder_and_from_its_file(tmp_path, form):
    write, file = CASES[form]
    refined = write(tmp_path)
    write_photos(tmp_path, refined)
    for path in (tmp_path, tmp_path / file):
        assert_reads_as(read_dataset(path), refined, form)
    assert len(read_poses(tmp_path)) == 5


@pytest.mark.parametrize(
    ("form", "write"), [(form, write) for form, all_ in VARIANTS.items() for write in all_]
)
def test_the_same_in_another_layout(tmp_path, form, write):
    refined = write(tmp_path)
    write_photos(tmp_path, refined)
    assert_reads_as(read_dataset(tmp_path), refined, form)


def test_a_log_gives_poses_in_the_order_of_names_and_none_where_it_says_so(tmp_path):
    refined = tanks_and_temples(tmp_path)
    write_photos(tmp_path, refined)
    file = tmp_path / "Ignatius_COLMAP_SfM.log"
    for path in (tmp_path, file):
        np.testing.assert_allclose(read_dataset(path).world_from_cam, refined.world_from_cam, atol=1e-12)
    file.write_text(file.read_text().replace("1 1 0\n", "1 -1 0\n"))
    assert read_dataset(tmp_path).posed.tolist() == [True, False, True, True, True]
    (tmp_path / "images/000004.jpg").unlink()
    with pytest.raises(InputError) as caught:
        read_dataset(tmp_path)
    assert_complete(caught.value, "pose_count_mismatch", file.name)


def test_bop_without_a_world_has_lenses_and_no_poses(tmp_path):
    write_photos(tmp_path, bop(tmp_path))
    cameras = json.loads((tmp_path / "scene_camera.json").read_text())
    for camera in cameras.values():
        del camera["cam_R_w2c"], camera["cam_t_w2c"]
    dump(tmp_path / "scene_camera.json", cameras)
    dataset = read_dataset(tmp_path)
    assert not dataset.posed.any()
    assert dataset.camera_of(0) == PINHOLE


def test_a_smaller_scale_of_the_photos_gets_a_smaller_lens(tmp_path):
    nerfies(tmp_path)
    dataset = read_dataset(tmp_path)
    assert dataset.file_names[0] == "rgb/2x/000000.png"
    assert dataset.camera_of(0).full().fx == 35.0


def edit(path: Path, change) -> None:
    document = json.loads(path.read_text())
    change(document)
    path.write_text(json.dumps(document))


BAD = [
    ("record3d", lambda f: edit(f / "metadata.json", lambda d: d["poses"].__setitem__(1, [1])), "poses[1]"),
    ("record3d", lambda f: edit(f / "metadata.json", lambda d: d["poses"][1].__setitem__(0, 9)), "poses[1]"),
    ("polycam", lambda f: edit(f / "keyframes/corrected_cameras/1.json", lambda d: d.pop("t_12")), "1.json"),
    ("polycam", lambda f: edit(f / "keyframes/corrected_cameras/1.json", lambda d: d.update(fx=0)), "1.json"),
    ("mvsnet", lambda f: dump(f / "cams/00000001_cam.txt", "extrinsic 1 2"), "00000001_cam.txt"),
    ("bop", lambda f: edit(f / "scene_camera.json", lambda d: d["1"].update(cam_R_w2c=[1] * 9)), "1"),
    ("bop", lambda f: edit(f / "scene_camera.json", lambda d: d["1"].pop("cam_K")), "json 1"),
    (
        "sdfstudio",
        lambda f: edit(f / "meta_data.json", lambda d: d["frames"][1].pop("camtoworld")),
        "frames[1]",
    ),
    (
        "sdfstudio",
        lambda f: edit(f / "meta_data.json", lambda d: d["frames"][1].update(intrinsics=[[1]])),
        "[1]",
    ),
    ("nerfies", lambda f: edit(f / "camera/000001.json", lambda d: d.update(skew=30)), "000001.json skew"),
    ("nerfies", lambda f: edit(f / "camera/000001.json", lambda d: d.pop("position")), "000001.json"),
]


@pytest.mark.parametrize(("form", "spoil", "where"), BAD)
def test_one_bad_row_costs_one_image_its_pose(tmp_path, form, spoil, where):
    write_photos(tmp_path, CASES[form][0](tmp_path))
    spoil(tmp_path)
    assert read_dataset(tmp_path).posed.tolist() == [True, False, True, True, True]
    with pytest.raises(InputError) as caught:
        read_dataset(tmp_path, strict=True)
    assert_complete(caught.value, caught.value.code, where)


@pytest.mark.parametrize(
    ("change", "code", "where"),
    [
        (
            lambda text: text.replace("radial-tangential", "fov"),
            "camera_model_unsupported",
            "distortion_model",
        ),
        (lambda text: text.replace("intrinsics: [70.0,", "intrinsics: ["), "pose_file_invalid", "intrinsics"),
        (lambda text: text[: text.index("data:")], "pose_file_invalid", "T_BS"),
        (lambda text: None, "pose_file_invalid", "sensor.yaml"),
    ],
)
def test_a_bad_sensor_file_is_named(tmp_path, change, code, where):
    write_photos(tmp_path, euroc(tmp_path))
    file = tmp_path / "mav0/cam0/sensor.yaml"
    text = change(file.read_text())
    file.unlink()
    if text is not None:
        file.write_text(text)
    with pytest.raises(InputError) as caught:
        read_dataset(tmp_path)
    assert_complete(caught.value, code, where)


def test_a_line_of_a_log_that_is_bad_costs_one_image_its_pose(tmp_path):
    write_photos(tmp_path, tanks_and_temples(tmp_path))
    file = tmp_path / "Ignatius_COLMAP_SfM.log"
    lines = file.read_text().splitlines()
    lines[6] += " 7"
    file.write_text("\n".join(lines))
    assert read_dataset(tmp_path).posed.tolist() == [True, False, True, True, True]
    with pytest.raises(InputError) as caught:
        read_dataset(tmp_path, strict=True)
    assert_complete(caught.value, "pose_file_invalid", "line 6")
