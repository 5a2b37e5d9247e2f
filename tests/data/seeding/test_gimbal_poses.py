"""Photos that matches did not place start at the poses of GPS and a drone's gimbal, in the others' frame."""

from __future__ import annotations

import importlib.util

import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from biresnerf.data.formats.positions.position_priors import position_priors
from biresnerf.data.formats.read_dataset import read_dataset
from biresnerf.data.model.measured_places import PositionPriors
from biresnerf.data.seeding.initial_poses import InitialPoses
from biresnerf.data.seeding.missing_poses import fill_measured
from biresnerf.data.seeding.seed_poses import seed_poses
from biresnerf.geometry.pose_error import pose_error, rotation_between_deg
from biresnerf.geometry.similarity import Similarity
from tests.data.photos.geotagged import geotag
from tests.data.scenes import plain_features

COUNT = 24
WORLD_FROM_METRES = Similarity(
    0.05, Rotation.from_rotvec([0.4, -1.1, 2.0]).as_matrix(), np.array([5.0, -7, 2])
)
MOUNTED = Rotation.from_rotvec(
    [0.0, np.radians(4), np.radians(90)]
).as_matrix()  # of the camera in the gimbal
MISSING = [0, 5, 6, 7, 13]
ORIGIN = (46.5, 6.6, 400.0)
NORTH_M, EAST_M = 111_167.0, 76_800.0  # metres of a degree there


def angles_deg(seed: int = 1) -> np.ndarray:
    """Yaw, pitch and roll [n, 3] of a flight to and fro that looks down, some of it to the side."""
    rng = np.random.default_rng(seed)
    yaw = np.where(np.arange(COUNT) // 6 % 2, 200.0, 20.0)
    pitch = np.where(np.arange(COUNT) % 3, -90.0, -60.0)
    return np.stack([yaw, pitch, np.zeros(COUNT)], 1) + rng.normal(0, 2, (COUNT, 3))


def flight() -> np.ndarray:
    """Cameras [n, 4, 4] in metres along east, north and up."""
    poses = np.tile(np.eye(4), (COUNT, 1, 1))
    yaw, pitch, roll = angles_deg().T
    # About the viewing axis first, then up, then round; a level camera to the north looks along y.
    turn = Rotation.from_euler("zxz", np.stack([roll, pitch - 90, -yaw], 1), degrees=True)
    poses[:, :3, :3] = turn.as_matrix()
    poses[:, :3, 3] = np.stack(
        [20.0 * (np.arange(COUNT) % 6), 25.0 * (np.arange(COUNT) // 6), np.full(COUNT, 80.0)], 1
    )
    return poses


def measured(gimbal_deg: float, gps_m: float, seed: int = 1) -> PositionPriors:
    rng, poses = np.random.default_rng(seed), flight()
    off = Rotation.from_rotvec(rng.normal(0, np.radians(gimbal_deg), (COUNT, 3))).as_matrix()
    at = poses[:, :3, 3] + rng.normal(0, gps_m, (COUNT, 3))
    unknown = np.full((COUNT, 3), np.nan)
    return PositionPriors("EXIF", np.arange(COUNT), at, unknown, ORIGIN, 4326, off @ poses[:, :3, :3])


def cameras() -> np.ndarray:
    """The cameras in a frame of others, mounted askew."""
    poses = flight()
    poses[:, :3, :3] = poses[:, :3, :3] @ MOUNTED
    return WORLD_FROM_METRES.apply_to_poses(poses)


def without(missing: list[int]) -> tuple[np.ndarray, np.ndarray]:
    known, poses = np.ones(COUNT, dtype=bool), cameras()
    known[missing], poses[missing] = False, np.eye(4)
    return poses, known


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_missing_poses_are_measured_in_the_frame_of_the_others_with_the_cameras_mounting(seed):
    poses, known = without(MISSING)
    filled = fill_measured(poses, known, measured(0.5, 0.5, seed))
    assert np.flatnonzero(filled).tolist() == MISSING
    truth = cameras()
    assert rotation_between_deg(poses[MISSING], truth[MISSING]).max() < 3
    apart = np.linalg.norm(poses[MISSING, :3, 3] - truth[MISSING, :3, 3], axis=1)
    assert apart.max() < 2.5 * WORLD_FROM_METRES.scale
    np.testing.assert_array_equal(poses[known], truth[known])


def test_a_gross_position_and_photos_without_angles_are_not_used():
    poses, known = without(MISSING)
    priors = measured(0.5, 0.5)
    priors.positions_m[5] += [9000.0, 0, 0]
    priors.rotations[13] = np.nan
    assert np.flatnonzero(fill_measured(poses, known, priors)).tolist() == [0, 6, 7]


def test_angles_and_positions_that_the_others_contradict_place_nothing():
    wrong = Rotation.random(COUNT, random_state=4).as_matrix()
    priors = measured(0.5, 0.5)
    for rotations, positions in ((wrong, priors.positions_m), (priors.rotations, wrong[:, 0] * 50)):
        poses, known = without(MISSING)
        other = PositionPriors("EXIF", priors.rows, positions, priors.accuracy_m, ORIGIN, 4326, rotations)
        assert not fill_measured(poses, known, other).any()
    poses, known = without(list(range(2, COUNT)))  # two cameras tell no frame
    assert not fill_measured(poses, known, priors).any()


def write_flight(folder, picture=None) -> None:
    for i, (pose, angles) in enumerate(zip(flight(), angles_deg(), strict=True)):
        east, north, up = pose[:3, 3]
        text = " ".join(
            f'drone-dji:Gimbal{name}Degree="{angle:+.2f}"'
            for name, angle in zip(("Yaw", "Pitch", "Roll"), angles, strict=True)
        )
        noise = np.random.default_rng(i).integers(0, 256, (48, 64, 3), dtype=np.uint8)
        exif = geotag(ORIGIN[0] + north / NORTH_M, ORIGIN[1] + east / EAST_M, ORIGIN[2] + up)
        Image.fromarray(noise).save(folder / f"DJI_{i:04}.jpg", exif=exif, xmp=text.encode(), quality=95)


def test_a_flight_without_matches_has_the_poses_of_its_gps_and_gimbal(tmp_path):
    write_flight(tmp_path)
    (candidate,) = seed_poses(read_dataset(tmp_path), "none").candidates
    assert set(candidate.sources) == {candidate.source} == {"gimbal"}
    assert not candidate.guessed.any()
    found = pose_error(candidate.world_from_cam, flight())
    assert found.own_frame.rotation_deg.max < 0.1  # east, north and up
    assert found.aligned.centre_percent.max < 1.0


@pytest.mark.slow
@pytest.mark.skipif(
    importlib.util.find_spec("pycolmap") is None, reason="pycolmap is not installed (extra: colmap)"
)
def test_a_flight_that_matches_nothing_says_what_is_not_known(tmp_path):
    write_flight(tmp_path)
    with plain_features():
        dataset = seed_poses(read_dataset(tmp_path)).dataset
    assert {frame.pose_source for frame in dataset.frames} == {"gimbal"}
    assert any("0 of 24" in text and "not known, nor how" in text for text in dataset.warnings)


def test_a_table_gives_positions_and_photos_the_angles(tmp_path):
    write_flight(tmp_path)
    (tmp_path / "positions.csv").write_text(
        "name,lat,lon,alt\nDJI_0003.jpg,46.5,6.6,480\nDJI_0004.jpg,46.6,6.7,480\n"
    )
    priors = position_priors(read_dataset(tmp_path))
    assert priors.rows.tolist() == [3, 4]
    assert rotation_between_deg(priors.rotations, flight()[3:5, :3, :3]).max() < 0.02


def test_a_few_measured_poses_are_doubted_as_guesses_are():
    sources = ("colmap",) * 9 + ("gimbal",)
    start = InitialPoses(np.tile(np.eye(4), (10, 1, 1)), "colmap", sources)
    assert np.flatnonzero(start.guessed).tolist() == [9]
    assert np.flatnonzero(~start.reliable).tolist() == [9]
