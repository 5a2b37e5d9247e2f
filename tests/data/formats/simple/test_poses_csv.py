"""What results say of each pose: poses.csv has it as a table, poses.json with all digits."""

import csv
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from biresnerf.data.formats.simple.poses_csv import write_poses_csv
from biresnerf.data.formats.simple.poses_json import read_poses_json, write_poses_json
from biresnerf.uncertainty import PoseUncertainty
from tests.data.formats.random_sets import random_result

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
