"""A whole run with fixed cameras, and one with a rig: the files at the end."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from biresnerf.data.formats.colmap.read_model import read_colmap_model
from biresnerf.data.formats.read_dataset import read_dataset
from biresnerf.data.formats.simple.poses_json import read_poses_json
from biresnerf.data.formats.transforms.write_transforms import write_transforms
from biresnerf.data.model.colmap_scene import (
    ColmapFrame,
    ColmapModel,
    ColmapRig,
    matrix_of_pose,
    rigid_pose_of,
)
from biresnerf.data.model.refined_set import refined_set
from biresnerf.data.synthetic.scene import write_synthetic_scene
from biresnerf.geometry.perturb import perturb_poses
from biresnerf.geometry.rigid import rigid_inverse
from biresnerf.pipeline import refine_poses
from tests.refinement.tiny_scene import tiny_run

pytestmark = pytest.mark.slow

FIXED = ("./train/r_1", "train/r_4.png")


@pytest.fixture(scope="module")
def noisy(tmp_path_factory):
    folder = tmp_path_factory.mktemp("scene")
    path = write_synthetic_scene(folder, 7, 24, seed=3)
    dataset = read_dataset(path)
    write_transforms(dataset, perturb_poses(dataset.world_from_cam, 0.05, 1), path)
    return read_dataset(path)


def test_fixed_cameras_keep_every_bit_in_every_file_and_the_others_move(noisy, tmp_path):
    refine_poses(noisy, tmp_path, tiny_run(start="given", fixed=FIXED, verdict=False))
    given = json.loads((noisy.root / "transforms.json").read_text())["frames"]
    after = json.loads((tmp_path / "transforms.json").read_text())["frames"]
    same = [i for i, (a, b) in enumerate(zip(given, after, strict=True)) if a == b]
    assert same == [1, 4]
    model = read_colmap_model(tmp_path / "colmap/sparse/0")
    before = refined_set(noisy, noisy.world_from_cam).model
    for number in (2, 5):  # ids count from 1
        one, other = model.images[number].cam_from_world, before.images[number].cam_from_world
        assert np.array_equal(one.quat_wxyz, other.quat_wxyz)
        assert np.array_equal(one.translation, other.translation)
    document = read_poses_json(tmp_path / "poses.json")
    assert [i for i, image in enumerate(document.images) if "fixed" in image.flags] == [1, 4]
    assert document.input_from_optimised.scale == 1.0
    for i, image in enumerate(document.images):
        assert (image.world_from_cam == image.world_from_cam_before) == (i in (1, 4))


def as_rig(dataset):
    """The set as a COLMAP model whose images 0 and 1, 2 and 3 were taken by one rig each moment; 4 to 6 alone."""
    poses = dataset.world_from_cam.copy()
    second_from_first = np.eye(4)
    second_from_first[:3, 3] = [-0.4, 0.05, 0.0]
    for first in (0, 2):
        poses[first + 1] = poses[first] @ rigid_inverse(second_from_first)
    dataset = replace(
        dataset,
        cameras=(dataset.cameras[0], dataset.cameras[0]),
        frames=tuple(
            replace(frame, name=dataset.file_names[i], camera=int(i in (1, 3)), world_from_cam=poses[i])
            for i, frame in enumerate(dataset.frames)
        ),
    )
    model = refined_set(dataset, poses).model
    frames = {}
    for number, images in enumerate([(1, 2), (3, 4), (5,), (6,), (7,)], start=11):
        taken = tuple((("CAMERA", model.images[i].camera_id), i) for i in images)
        frames[number] = ColmapFrame(number, 9, model.images[images[0]].cam_from_world, taken)
    rig = ColmapRig(9, ("CAMERA", 1), {("CAMERA", 2): rigid_pose_of(second_from_first)})
    model = ColmapModel(Path(), "binary", model.cameras, model.images, model.points, {9: rig}, frames)
    return replace(
        dataset, source=replace(dataset.source, colmap=model, document={}, dialect="images")
    ), model


def test_a_rig_stays_as_it_is_bolted_and_moves_as_one(noisy, tmp_path):
    dataset, before = as_rig(noisy)
    refine_poses(dataset, tmp_path, tiny_run(start="given", verdict=False))
    after = read_colmap_model(tmp_path / "colmap/sparse/0")
    assert list(after.frames) == list(before.frames)
    assert np.array_equal(
        after.rigs[9].sensor_from_rig["CAMERA", 2].quat_wxyz,
        before.rigs[9].sensor_from_rig["CAMERA", 2].quat_wxyz,
    )
    sensor_from_rig = matrix_of_pose(after.rigs[9].sensor_from_rig["CAMERA", 2])
    for frame in after.frames.values():
        rig_from_world = matrix_of_pose(frame.rig_from_world)
        assert np.abs(rig_from_world - matrix_of_pose(before.frames[frame.id].rig_from_world)).max() > 1e-3
        for (_, camera), image in frame.data_ids:
            expected = rig_from_world if camera == 1 else sensor_from_rig @ rig_from_world
            np.testing.assert_allclose(
                matrix_of_pose(after.images[image].cam_from_world), expected, atol=1e-9
            )
