"""Each common mistake in written poses is undone by the reading that is named after it."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from biresnerf.data.formats.read_dataset import read_dataset
from biresnerf.data.given_poses.readings import poses_read_as, read_as
from biresnerf.data.model.conventions import world_from_cam_of_file
from biresnerf.data.model.dataset import SourceFormat
from biresnerf.errors import InputError
from biresnerf.options.given_poses import PoseReading
from biresnerf.options.refine_options import parse_options
from tests.data.formats.simple import trajectories

F = np.diag([1.0, -1.0, -1.0, 1.0])


def true_poses() -> np.ndarray:
    poses = np.tile(np.eye(4), (6, 1, 1))
    poses[:, :3, :3] = Rotation.random(6, random_state=1).as_matrix()
    poses[:, :3, 3] = np.random.default_rng(2).normal(size=(6, 3))
    return poses


def transposed(poses: np.ndarray) -> np.ndarray:
    swapped = poses.copy()
    swapped[:, :3, :3] = poses[:, :3, :3].transpose(0, 2, 1)
    return swapped


def of_unity(poses: np.ndarray) -> np.ndarray:
    """The same cameras where z of the world points the other way, and y of the camera up: both frames left-handed."""
    return np.diag([1.0, 1, -1, 1]) @ poses @ np.diag([1.0, -1, 1, 1])


# What stands in a transforms.json where its camera-to-world matrices with OpenGL axes should.
MISTAKES: list[tuple[tuple[PoseReading, ...], object]] = [
    ((), lambda poses: poses @ F),
    (("opencv_axes",), lambda poses: poses),
    (("inverted",), lambda poses: np.linalg.inv(poses @ F)),
    (("inverted", "opencv_axes"), np.linalg.inv),
    (("transposed",), lambda poses: transposed(poses @ F)),
    (("transposed", "opencv_axes"), transposed),
    (("left_handed",), of_unity),
    # The photo was turned clockwise after the pose was taken: its right is what was up.
    (("rolled_90",), lambda poses: poses @ np.array([[0, -1, 0, 0], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]) @ F),
    (("rolled_180",), lambda poses: poses @ np.diag([-1.0, -1, 1, 1]) @ F),
]  # fmt: skip
NAMES = [" ".join(reading) or "nothing" for reading, _ in MISTAKES]


@pytest.mark.parametrize(("reading", "mistake"), MISTAKES, ids=NAMES)
def test_a_wrong_transforms_json_is_read_as_it_was_meant(reading, mistake) -> None:
    applied = np.eye(4)
    applied[:3] = np.array([[0, 1, 0, 0.5], [-1, 0, 0, 0.0], [0, 0, 1, 2.0]])
    world_moved, scale = np.eye(4), 1.0
    for world_moved, scale in ((np.eye(4), 1.0), (applied, 2.0)):
        source = SourceFormat("nerfstudio", applied_transform=world_moved, applied_scale=scale)
        meant = world_from_cam_of_file(true_poses() @ F, world_moved, scale)
        as_read = world_from_cam_of_file(mistake(true_poses()), world_moved, scale)
        np.testing.assert_allclose(poses_read_as(as_read, source, reading), meant, atol=1e-12)


def test_a_colmap_model_with_camera_to_world_poses_or_quaternions_of_scipy_is_read_as_it_was_meant() -> None:
    truth, source = true_poses(), SourceFormat("colmap")
    np.testing.assert_allclose(poses_read_as(np.linalg.inv(truth), source, ["inverted"]), truth, atol=1e-12)
    cam_from_world = np.linalg.inv(truth)
    wrong = cam_from_world.copy()
    xyzw = Rotation.from_matrix(cam_from_world[:, :3, :3]).as_quat()
    wrong[:, :3, :3] = Rotation.from_quat(np.roll(xyzw, -1, axis=1)).as_matrix()  # x taken for w, and so on
    np.testing.assert_allclose(poses_read_as(np.linalg.inv(wrong), source, ["xyzw"]), truth, atol=1e-9)
    np.testing.assert_allclose(poses_read_as(truth, source, ["wxyz", "opencv_axes"]), truth, atol=1e-12)


def test_a_trajectory_with_the_scalar_first_is_read_as_it_was_meant() -> None:
    truth = true_poses()
    wrong = truth.copy()
    wxyz = np.roll(Rotation.from_matrix(truth[:, :3, :3]).as_quat(), 1, axis=1)
    wrong[:, :3, :3] = Rotation.from_quat(wxyz).as_matrix()
    np.testing.assert_allclose(poses_read_as(wrong, SourceFormat("tum"), ["wxyz"]), truth, atol=1e-9)


def test_what_a_model_had_beside_its_poses_goes_with_them(tmp_path) -> None:
    trajectories.colmap_set(tmp_path, registered=3)
    given = read_dataset(tmp_path)
    read = read_as(given, ["inverted"])
    assert given.source.colmap is not None
    assert read.source.colmap is None
    assert read.posed.tolist() == given.posed.tolist() == [True, True, True, False]
    for before, after in zip(given.frames[:3], read.frames, strict=False):
        np.testing.assert_allclose(after.world_from_cam, np.linalg.inv(before.world_from_cam), atol=1e-12)
    assert read_as(given, ()) is given


@pytest.mark.parametrize(
    "both", [("opencv_axes", "opengl_axes"), ("wxyz", "xyzw"), ("rolled_90", "rolled_180")]
)
def test_what_cannot_both_be_is_refused(both) -> None:
    with pytest.raises(InputError, match=f"cannot be both {both[0]} and {both[1]}"):
        parse_options({"given_poses": list(both)})
