"""Poses of other programs that are not read are named, and what only looks like them is not."""

from __future__ import annotations

import pytest
from PIL import Image

from biresnerf.data.formats.read_dataset import read_dataset
from biresnerf.data.formats.unread_poses import UNREAD
from biresnerf.errors import InputError

# The beginning of a file as each program's documentation shows it.
FILES = {
    "block.xml": '<?xml version="1.0"?>\n<BlocksExchange version="2.1">',
    "p4d_calibrated_external_camera_parameters.txt": "imageName X Y Z Omega Phi Kappa\n",
    "scene.nvm": "NVM_V3\n\n4\n",
    "scene.mvs": "MVS\x00",
    "odometry.csv": "timestamp, frame, x, y, z, qx, qy, qz, qw\n",
    "lowres_wide.traj": "3845.6 0.1 0.2 0.3 1.5e-3 0.5 0.6\n",
}


@pytest.fixture
def photos(tmp_path):
    (tmp_path / "images").mkdir()
    for number in range(4):
        Image.new("RGB", (32, 32), (number, 0, 0)).save(tmp_path / "images" / f"{number}.png")
    return tmp_path


@pytest.mark.parametrize("name", FILES)
def test_the_form_is_named(photos, name):
    (photos / name).parent.mkdir(parents=True, exist_ok=True)
    (photos / name).write_text(FILES[name])
    with pytest.raises(InputError) as caught:
        read_dataset(photos)
    assert (caught.value.code, caught.value.where) == ("poses_not_read", name)


def test_every_form_is_tried():
    assert len(UNREAD) == len(FILES)


def test_other_files_of_such_names_are_left_alone(photos):
    for name in (
        "notes.csv",
        "images/0.xmp",
        "run.log",
        "metadata.json",
        "meta_data.json",
        "a.xml",
        "camera/0.json",
    ):
        (photos / name).parent.mkdir(exist_ok=True)
        (photos / name).write_text('{"of": "another program"}')
    assert len(read_dataset(photos)) == 4
