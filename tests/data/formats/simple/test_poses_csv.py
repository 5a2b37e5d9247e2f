"""What results say of each pose: poses.csv has it as a table, poses.json with all digits."""

import csv
import posixpath
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from biresnerf.data.formats.read_dataset import read_dataset, read_poses
from biresnerf.data.formats.simple.poses_csv import write_poses_csv
from biresnerf.data.formats.simple.poses_json import read_poses_json, write_poses_json
from biresnerf.uncertainty import PoseUncertainty
from tests.data.formats.random_sets import random_poses, random_result
from tests.data.scenes import write_image

POSES = random_poses(np.random.default_rng(2), 4)
COVARIANCE = tuple(tuple(float(6 * i + j) for j in range(6)) for i in range(6))
KNOWN = PoseUncertainty(
    known_from="matches", rotation_deg=0.25, position=1 / 3, position_percent=2.0, covariance=COVARIANCE
)
UNKNOWN = PoseUncertainty(known_from="nothing", why_unknown='of "it", nothing')


@pytest.fixture(name="refined")
def stated():
    """A result of whose first pose nothing is known."""
    refined = random_result(1, several=True)
    first, *others = refined.images
    said = (replace(first, uncertainty=UNKNOWN), *(replace(image, uncertainty=KNOWN) for image in others))
    return replace(refined, images=said)


def test_poses_csv_has_each_pose_and_how_exactly_it_is_known(refined, tmp_path):
    write_poses_csv(refined, tmp_path / "poses.csv")
    with (tmp_path / "poses.csv").open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    for row, image in zip(rows, refined.images, strict=True):
        assert row["image"] == image.name
        np.testing.assert_array_equal([float(row[axis]) for axis in "xyz"], image.world_from_cam[:3, 3])
        rotation = Rotation.from_quat([float(row["q" + part]) for part in "xyzw"]).as_matrix()
        np.testing.assert_allclose(rotation, image.world_from_cam[:3, :3], atol=1e-12)
    said = [
        (row["rotation_deg_90"], row["position_90"], row["known_from"], row["why_unknown"]) for row in rows
    ]
    assert said[0] == ("", "", "nothing", 'of "it", nothing')
    assert said[1:] == [("0.25", repr(1 / 3), "matches", "")] * (len(rows) - 1)


def test_poses_json_keeps_what_is_said_of_each_pose(refined, tmp_path):
    write_poses_json(refined, tmp_path / "poses.json")
    found = [image.uncertainty for image in read_poses_json(tmp_path / "poses.json").images]
    assert found == [UNKNOWN] + [KNOWN] * (len(refined.images) - 1)


@pytest.mark.parametrize(
    "head",
    [
        "image,x,y,z,qw,qx,qy,qz",
        "filename;tx;ty;tz;q_w;q_x;q_y;q_z",
        "# Image Name,pos_x,pos_y,pos_z,rot_w,rot_x,rot_y,rot_z,note",
        "# poses of Tuesday, in metres\nphoto\tpx\tpy\tpz\tqw\tqx\tqy\tqz\n# the first lap",
    ],
)
def test_a_table_of_positions_and_quaternions_is_read_by_its_head(tmp_path, head):
    lines = [head]
    for index, pose in enumerate(POSES):
        x, y, z, w = Rotation.from_matrix(pose[:3, :3]).as_quat().tolist()
        values = [f"{index}.png", *map(repr, [*pose[:3, 3].tolist(), w, x, y, z])]
        lines.append(max(",;\t", key=head.count).join(values))
        write_image(tmp_path / f"images/{index}.png", index)
    (tmp_path / "table.csv").write_text("\n".join(lines))
    dataset = read_dataset(tmp_path)
    assert dataset.source.dialect == "csv"
    np.testing.assert_allclose(dataset.world_from_cam, POSES, atol=1e-12)
    assert "table.csv was read as camera to world with OpenCV axes" in dataset.warnings


def test_a_results_table_is_read_back(refined, tmp_path):
    write_poses_csv(refined, tmp_path / "poses.csv")
    found = read_poses(tmp_path / "poses.csv")
    for image in refined.images:
        np.testing.assert_allclose(found[posixpath.normpath(image.name)], image.world_from_cam, atol=1e-12)


@pytest.mark.parametrize("head", ["image,x,y,z", "time,x,y,z,qw,qx,qy,qz", "name,latitude,longitude"])
def test_other_tables_are_left_alone(tmp_path, head):
    for index in range(3):
        write_image(tmp_path / f"images/{index}.png", index)
    (tmp_path / "table.csv").write_text(f"{head}\n" + "\n".join(f"{i}.png,1,2,3,1,0,0,0" for i in range(3)))
    assert read_dataset(tmp_path).source.dialect == "images"
