"""Pose files that other programs wrote themselves: read as an independent reader does."""

from __future__ import annotations

import csv
import json
import shutil
from xml.etree import ElementTree

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from biresnerf.data.formats.photogrammetry.realitycapture import parse_realitycapture_xmp
from biresnerf.data.formats.read_dataset import read_dataset, read_poses
from biresnerf.data.model.dataset import Dataset
from tests.data.formats.posed_sets import write_plain_photos
from tests.data.test_real_sets import ROOT

FILES = ROOT / "real_poses"
if not FILES.is_dir():
    pytest.skip(
        "no image set real_poses: set BIRESNERF_TEST_DATA to the folder that holds it",
        allow_module_level=True,
    )


def matrix(lines: list[str]) -> np.ndarray:
    return np.array([line.split() for line in lines], dtype=float)


def assert_projects(dataset: Dataset, index: int, in_cam: np.ndarray, pixel: np.ndarray) -> None:
    full = dataset.camera_of(index).full()
    ours = [full.fx * in_cam[0] / in_cam[2] + full.cx, full.fy * in_cam[1] / in_cam[2] + full.cy]
    np.testing.assert_allclose(ours, pixel, atol=1e-6)


def test_mvsnets_cameras_project_as_their_matrices_do(tmp_path):
    """LiangliangNan/RealCameraViewer, whose principal points are in the middles of its photos."""
    shutil.copytree(FILES / "mvsnet/cams", tmp_path / "cams")
    extrinsics, intrinsics = [], []
    for file in sorted((tmp_path / "cams").iterdir()):
        lines = file.read_text().splitlines()
        extrinsics.append(matrix(lines[1:5]))
        intrinsics.append(matrix(lines[7:10]))
        width, height = np.rint(2 * intrinsics[-1][:2, 2]).astype(int)
        write_plain_photos(tmp_path / "images", [file.name.replace("_cam.txt", ".png")], (width, height))
    dataset = read_dataset(tmp_path)
    assert len(dataset) == 40
    for index, pose in enumerate(dataset.world_from_cam):
        point = pose @ [0.3, -0.2, 4.0, 1.0]
        x, y, z = intrinsics[index] @ (extrinsics[index] @ point)[:3]
        assert_projects(dataset, index, np.array([0.3, -0.2, 4.0]), np.array([x / z, y / z]))


def test_3dmatchs_frames_have_the_matrices_of_their_files(tmp_path):
    """andyzeng/3dmatch-toolbox, its demonstration of fusion; pixels are counted from the first one's middle."""
    (tmp_path / "rgbd-frames").mkdir()
    files = sorted((FILES / "3dmatch").glob("*.pose.txt"))
    for file in files:
        shutil.copy(file, tmp_path / "rgbd-frames")
    shutil.copy(FILES / "3dmatch/camera-intrinsics.txt", tmp_path)
    names = [file.name.replace(".pose.txt", ".color.png") for file in files]
    write_plain_photos(tmp_path / "rgbd-frames", names)
    dataset = read_dataset(tmp_path)
    assert len(dataset) == 50
    for index, file in enumerate(files):
        given = matrix(file.read_text().splitlines()[:4])
        np.testing.assert_allclose(
            dataset.world_from_cam[index], given, atol=1e-4
        )  # its rotations are rounded
        x, y, z = matrix((tmp_path / "camera-intrinsics.txt").read_text().splitlines()[:3]) @ [0.3, -0.2, 4.0]
        assert_projects(dataset, index, np.array([0.3, -0.2, 4.0]), np.array([x / z, y / z]) + 0.5)


def test_bops_scene_projects_as_its_matrices_do(tmp_path):
    """patricksko/PoseEstimator: ten rendered views; pixels are counted from the first one's middle."""
    shutil.copy(FILES / "bop/scene_camera.json", tmp_path)
    cameras = json.loads((tmp_path / "scene_camera.json").read_text())
    write_plain_photos(tmp_path / "rgb", [f"{int(number):06}.png" for number in cameras])
    dataset = read_dataset(tmp_path)
    assert len(dataset) == int(dataset.posed.sum()) == 10
    for index, camera in enumerate(cameras.values()):
        point = (dataset.world_from_cam[index] @ [20.0, -30.0, 700.0, 1.0])[:3]
        in_cam = np.reshape(camera["cam_R_w2c"], (3, 3)) @ point + camera["cam_t_w2c"]
        np.testing.assert_allclose(in_cam, [20.0, -30.0, 700.0], atol=1e-3)  # its rotations are rounded
        x, y, z = np.reshape(camera["cam_K"], (3, 3)) @ [20.0, -30.0, 700.0]
        assert_projects(dataset, index, np.array([20.0, -30.0, 700.0]), np.array([x / z, y / z]) + 0.5)


def csv_rows() -> dict[str, list[str]]:
    lines = (FILES / "realitycapture/parking.csv").read_text().splitlines()
    return {row[0]: row[1:] for row in csv.reader(lines) if not row[0].startswith("#")}


def test_realitycaptures_two_exports_of_the_same_photos_agree():
    """KU-Leuven-Geomatics/geomapi: a csv with omega, phi and kappa, and the XMP of two of its photos."""
    from_csv = read_poses(FILES / "realitycapture/parking.csv")
    assert len(from_csv) == len(csv_rows()) == 706
    parsed = parse_realitycapture_xmp(FILES, FILES / "realitycapture")
    assert [entry.name for entry in parsed.entries] == ["DJI_0085.jpg", "IMG_8834.jpg"]
    for entry in parsed.entries:
        text = (FILES / "realitycapture" / entry.where).read_text()
        rows = ElementTree.fromstring(text).findtext(".//{*}Rotation", "").split()
        assert entry.world_from_cam is not None
        np.testing.assert_allclose(
            entry.world_from_cam[:3, :3], np.reshape(rows, (3, 3)).astype(float).T, atol=1e-9
        )
        np.testing.assert_allclose(
            entry.world_from_cam, from_csv[entry.name.replace("jpg", "JPG")], atol=1e-9
        )


def test_realitycaptures_photos_are_level_as_a_survey_takes_them():
    """The other 704 rows have no second file; but cameras on a tripod or a drone hold their side level."""
    sides = np.array([abs(pose[2, 0]) for pose in read_poses(FILES / "realitycapture/parking.csv").values()])
    assert np.median(sides) < 0.02
    assert (sides < 0.1).mean() > 0.8
    x, y, z, omega, phi, kappa = map(float, csv_rows()["DJI_0363.JPG"])
    turn = Rotation.from_euler("YXZ", [kappa, phi, -omega], degrees=True).as_matrix() @ np.diag([1, -1, -1])
    found = read_poses(FILES / "realitycapture/parking.csv")["DJI_0363.JPG"]
    np.testing.assert_allclose(found[:3], np.column_stack([turn, (x, y, z)]), atol=1e-9)


@pytest.mark.parametrize(("name", "count"), [("railway", 191), ("road", 78)])
def test_metashapes_cameras_have_the_transforms_of_its_file(name, count):
    """KU-Leuven-Geomatics/geomapi: version 1.5, of a medium format camera and of a drone."""
    file = FILES / f"metashape/{name}.xml"
    found = read_poses(file)
    cameras = {one.get("label"): one for one in ElementTree.parse(file).iter("camera")}
    assert len(found) == len(cameras) == count
    for label, pose in found.items():
        given = np.reshape(cameras[label].findtext("transform").split(), (4, 4)).astype(float)
        np.testing.assert_allclose(pose, given, atol=1e-12)
