"""Poses of feature matches in metres on Earth, from the GPS positions of photos whose places are known."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from biresnerf.data.formats.positions.position_priors import position_priors
from biresnerf.data.model.dataset import Dataset, Frame, SourceFormat
from biresnerf.data.seeding.match_poses import MatchedPoses, in_measured_frame
from biresnerf.geometry.camera.camera_models import Camera
from biresnerf.geometry.pose_error import rotation_between_deg
from biresnerf.geometry.similarity import Similarity
from tests.data.photos.geotagged import write_geotagged

COUNT = 24
ORIGIN = (48.8584, 2.2945, 33.0)
# Metres of a degree there, on WGS84 (NIMA TR8350.2: meridian and parallel, to the metre).
NORTH_M, EAST_M = 111_205.7, 73_386.9
ANY_FRAME = Similarity(0.03, Rotation.from_rotvec([0.4, -1.1, 2.0]).as_matrix(), np.array([5.0, -7.0, 2.0]))


def truth(line: bool = False) -> np.ndarray:
    """Cameras [n, 4, 4] 40 m around and above a place, in metres along east, north and up; or along a line."""
    angle = np.linspace(0, 2 * np.pi, COUNT, endpoint=False)
    poses = np.tile(np.eye(4), (COUNT, 1, 1))
    poses[:, :3, :3] = Rotation.from_euler("zx", np.stack([angle, np.full(COUNT, 2.0)], 1)).as_matrix()
    height = 20 + 6 * np.sin(3 * angle)
    poses[:, :3, 3] = np.stack([40 * np.cos(angle), 40 * np.sin(angle), height], 1)
    if line:
        poses[:, :3, 3] = np.stack([3.0 * np.arange(COUNT), np.zeros(COUNT), np.full(COUNT, 20.0)], 1)
    return poses


def photographed(folder, centres, noise_m=0.0, seed=1) -> Dataset:
    """Photos with the GPS positions of these centres [n, 3]."""
    rng, frames = np.random.default_rng(seed), []
    for i, centre in enumerate(centres + rng.normal(0, noise_m, centres.shape)):
        path = folder / f"{i:02}.jpg"
        place = (ORIGIN[0] + centre[1] / NORTH_M, ORIGIN[1] + centre[0] / EAST_M, ORIGIN[2] + centre[2])
        write_geotagged(path, place)
        frames.append(Frame(path.name, path, 0, None, None))
    camera = Camera("SIMPLE_PINHOLE", 16, 16, (20.0, 8.0, 8.0))
    return Dataset(folder, (camera,), tuple(frames), SourceFormat("images"))


def matched(poses: np.ndarray) -> MatchedPoses:
    """As COLMAP leaves them: in any frame and scale."""
    return MatchedPoses("incremental", ANY_FRAME.apply_to_poses(poses), np.ones(len(poses), dtype=bool))


def offsets(found: np.ndarray, poses: np.ndarray) -> np.ndarray:
    """Where cameras are, less where they were, but for the common origin [n, 3]."""
    apart = found[:, :3, 3] - poses[:, :3, 3]
    return apart - np.median(apart, axis=0)


def test_poses_come_back_in_metres_east_north_and_up(tmp_path):
    poses = truth()
    found = in_measured_frame(matched(poses), photographed(tmp_path, poses[:, :3, 3]))
    assert np.abs(offsets(found.world_from_cam, poses)).max() < 0.02
    assert rotation_between_deg(found.world_from_cam, poses).max() < 0.05
    origin = position_priors(photographed(tmp_path, poses[:, :3, 3])).origin
    assert abs(origin[0] - ORIGIN[0]) * NORTH_M < 20
    # The origin of the frame is the place that the report names.
    north = (origin[0] - ORIGIN[0]) * NORTH_M
    assert found.world_from_cam[0, 1, 3] + north == pytest.approx(poses[0, 1, 3], abs=0.05)


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_noise_and_one_wrong_position_do_little(tmp_path, seed):
    poses = truth()
    centres = poses[:, :3, 3].copy()
    centres[5] += [900.0, -500.0, 200.0]
    found = in_measured_frame(matched(poses), photographed(tmp_path, centres, noise_m=1.0, seed=seed))
    assert rotation_between_deg(found.world_from_cam, poses).max() < 3.0
    assert np.abs(offsets(found.world_from_cam, poses)).max() < 2.0


@pytest.mark.parametrize("off", [(1e3, 0, 0), (0, 0, 3e3), (0, 1e6, 0)])
def test_a_gross_error_among_few_positions_does_not_cost_the_frame(tmp_path, off):
    poses = truth()[::3]
    centres = poses[:, :3, 3].copy()
    centres[2] += off
    found = in_measured_frame(matched(poses), photographed(tmp_path, centres, noise_m=0.5))
    assert rotation_between_deg(found.world_from_cam, poses).max() < 3.0


def test_positions_on_a_line_or_at_one_place_or_of_few_photos_give_no_frame(tmp_path):
    for name, centres, noise in (
        ("line", truth(line=True)[:, :3, 3], 0.5),
        ("place", np.zeros((COUNT, 3)), 0.0),
        ("scatter", truth()[:, :3, 3] / 20, 2.0),
        ("few", truth()[:5, :3, 3], 0.0),
    ):
        (tmp_path / name).mkdir()
        start = matched(truth(line=name == "line")[: len(centres)])
        found = in_measured_frame(start, photographed(tmp_path / name, centres, noise_m=noise))
        assert found is start, name


def test_cameras_that_matches_did_not_place_have_no_say_and_stay(tmp_path):
    poses = truth()
    start = matched(poses)
    start.world_from_cam[3], start.placed[3] = np.eye(4), False
    found = in_measured_frame(start, photographed(tmp_path, poses[:, :3, 3]))
    np.testing.assert_array_equal(found.world_from_cam[3], np.eye(4))
