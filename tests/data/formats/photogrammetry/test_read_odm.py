"""shots.geojson of OpenDroneMap, interpreted as its source derives it from OpenSfM's reconstruction."""

from __future__ import annotations

import json

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from biresnerf.data.formats.read_dataset import read_dataset
from biresnerf.errors import InputError
from tests.data.formats.random_sets import random_poses
from tests.data.scenes import assert_complete, write_image
from tests.data.test_real_sets import ROOT

REAL = ROOT / "interop/28_odm_shots/project"
POSES = random_poses(np.random.default_rng(7), 4)  # in OpenSfM's world
UTM_FROM_WORLD = np.eye(4)
UTM_FROM_WORLD[:3, :3] = Rotation.from_euler("z", 1.5, degrees=True).as_matrix()
UTM_FROM_WORLD[:3, 3] = (576_000.0, 5_188_000.0, 0.0)
LENS = {"projection_type": "brown", "width": 64, "height": 48, "focal_x": 1.1, "focal_y": 1.1}
LENS |= {"c_x": 0.01, "c_y": -0.02, "k1": -0.02, "k2": 0.0, "p1": 0.001, "p2": 0.0, "k3": 0.0}


def project(folder, cameras: int = 1) -> None:
    """As opendm/shots.py: the centre moved, the rotation times the inverse of what moved it."""
    features = []
    for index, pose in enumerate(POSES):
        cam_from_world = np.linalg.inv(pose)
        turned = cam_from_world[:3, :3] @ np.linalg.inv(UTM_FROM_WORLD[:3, :3])
        shot = {
            "filename": f"DJI_{index}.png", "focal": 1.2, "width": 64, "height": 48,
            "translation": (UTM_FROM_WORLD @ pose[:, 3])[:3].tolist(),
            "rotation": Rotation.from_matrix(turned).as_rotvec().tolist(),
        }  # fmt: skip
        features.append({"type": "Feature", "geometry": {"type": "Point"}, "properties": shot})
        write_image(folder / "images" / f"DJI_{index}.png", index, (64, 48))
    (folder / "odm_report").mkdir()
    shots = {"type": "FeatureCollection", "features": features}
    (folder / "odm_report/shots.geojson").write_text(json.dumps(shots))
    (folder / "cameras.json").write_text(json.dumps({f"v2 dji {n}": LENS for n in range(cameras)}))


@pytest.mark.parametrize("named", ["", "odm_report/shots.geojson"])
def test_poses_are_in_the_utm_zone_and_the_lens_is_the_projects(tmp_path, named):
    project(tmp_path)
    dataset = read_dataset(tmp_path / named)
    assert dataset.source.dialect == "odm"
    np.testing.assert_allclose(dataset.world_from_cam, UTM_FROM_WORLD @ POSES, atol=1e-7)
    full = dataset.cameras[0].full()
    assert (full.fx, full.fy, full.cx, full.cy) == pytest.approx((70.4, 70.4, 32.64, 22.72))
    assert (full.k1, full.p1) == (-0.02, 0.001)


def test_of_several_cameras_the_focal_length_of_the_shot_is_taken(tmp_path):
    project(tmp_path, cameras=2)
    camera = read_dataset(tmp_path).cameras[0]
    assert camera.params[0] == pytest.approx(1.2 * 64)


@pytest.mark.parametrize(
    ("change", "where"),
    [
        (lambda d: d.update(features=[]), "features"),
        (lambda d: d["features"][1]["properties"].pop("rotation"), "features[1]"),
        (lambda d: d["features"].append(d["features"][0]), "features[4]"),
    ],
)
def test_a_bad_file_is_named(tmp_path, change, where):
    project(tmp_path)
    file = tmp_path / "odm_report/shots.geojson"
    document = json.loads(file.read_text())
    change(document)
    file.write_text(json.dumps(document))
    with pytest.raises(InputError) as caught:
        read_dataset(file, strict=True)
    code = "duplicate_image" if len(document["features"]) == 5 else "pose_file_invalid"
    assert_complete(caught.value, code, where)


def test_a_bad_shot_costs_one_image_its_pose(tmp_path):
    project(tmp_path)
    file = tmp_path / "odm_report/shots.geojson"
    document = json.loads(file.read_text())
    document["features"][1]["properties"]["rotation"] = [1]
    file.write_text(json.dumps(document))
    assert read_dataset(file).posed.tolist() == [True, False, True, True]


def test_a_real_project_looks_down_from_its_flight(tmp_path):
    if not REAL.is_dir():
        pytest.skip("no image set interop: set BIRESNERF_TEST_DATA to the folder that holds it")
    dataset = read_dataset(REAL)
    assert (len(dataset), int(dataset.posed.sum())) == (18, 18)
    poses = dataset.world_from_cam
    assert (poses[:, 2, 2] < -0.9).all()
    shots = json.loads((REAL / "odm_report/shots.geojson").read_text())["features"]
    centres = {shot["properties"]["filename"]: shot["properties"]["translation"] for shot in shots}
    for frame in dataset.frames:
        np.testing.assert_allclose(frame.world_from_cam[:3, 3], centres[frame.path.name])
    assert dataset.cameras[0].params[0] == pytest.approx(0.5555 * 400)
