"""Frame and offset of given poses, against known ones: axes turned, photos rolled, flanges, and nothing at all."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from biresnerf.geometry.body_offset import Tie, tie
from biresnerf.geometry.rigid import rigid_inverse, rotation_of, rotation_vectors
from tests.geometry.rigs import dome, jitter, look_at, similar

TURNED = Rotation.from_euler("zyx", [40, 70, -20], degrees=True).as_matrix()
FOUND_RAD, FOUND = 5e-4, 2e-3  # errors of poses by matches: 0.03 deg, and a share of the distance


def walk(cameras: int, rng: np.random.Generator) -> np.ndarray:
    """Cameras [n, 4, 4] along a path, looking in all directions."""
    centres = np.cumsum(rng.normal(size=(cameras, 3)) * [0.5, 0.5, 0.1], axis=0)
    return np.stack([look_at(c, c + rng.normal(size=3) * [1, 1, 0.3]) for c in centres])


def offset(rotvec_deg, shift=(0.0, 0.0, 0.0)) -> np.ndarray:
    motion = np.eye(4)
    motion[:3, :3], motion[:3, 3] = Rotation.from_rotvec(rotvec_deg, degrees=True).as_matrix(), shift
    return motion


def tied(truth, rng, body_from_cam=None, given_rad=0.0, given=0.0) -> Tie:
    """To poses as matches give them, of noisy ones in a frame that is turned and 2.5 times as large."""
    noisy = similar(jitter(truth, rng, given_rad, given), 2.5, TURNED, np.array([3.0, -1, 8]))
    if body_from_cam is not None:
        noisy = noisy @ rigid_inverse(body_from_cam)
    return tie(jitter(truth, rng, FOUND_RAD, FOUND), noisy)


def apart_deg(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.degrees(np.linalg.norm(rotation_vectors((a[:3, :3].T @ b[:3, :3])[None]))))


@pytest.mark.parametrize(
    "turn_deg", [(180, 0, 0), (0, 0, 90), (0, 0, -90), (0, 0, 180), (0, 90, 0), (69.3, 69.3, -69.3)]
)
@pytest.mark.parametrize("rig", [dome, walk])
def test_other_axes_and_rolls_are_found_exactly_and_the_frame_stays(rig, turn_deg):
    rng = np.random.default_rng(3)
    expected = offset(turn_deg)
    found = tied(rig(9, rng), rng, expected)
    assert found.offset is not None
    assert apart_deg(found.given_from_fitted.rotation, TURNED) < 0.1
    assert found.given_from_fitted.scale == pytest.approx(2.5, rel=2e-3)
    assert apart_deg(found.offset.body_from_cam, expected) < 0.1
    if max(np.abs(turn_deg)) in (90, 180):
        np.testing.assert_allclose(found.offset.body_from_cam, expected, atol=1e-12)
        assert found.offset.shift_deviation is None


def test_the_turn_and_the_shift_of_a_flange_are_found_with_their_deviation():
    rng = np.random.default_rng(5)
    expected = offset((30, -75, 95), (0.6, -0.9, 0.4))
    found = tied(walk(14, rng), rng, expected)
    assert found.offset is not None
    assert apart_deg(found.given_from_fitted.rotation, TURNED) < 0.1
    assert apart_deg(found.offset.body_from_cam, expected) < 0.1
    assert found.offset.shift_deviation is not None
    off = np.abs(found.offset.body_from_cam[:3, 3] - expected[:3, 3]).max()
    assert off < 3 * found.offset.shift_deviation < 0.1


def test_a_shift_that_looks_like_another_frame_is_not_reported_as_known():
    """Cameras at one distance that all look at one point: along their axes a shift is a change of scale."""
    rng = np.random.default_rng(6)
    found = tied(dome(12, rng), rng, offset((180, 0, 0), (0.0, 0.8, 0.0)))
    assert found.offset is not None
    shift = found.offset.body_from_cam[:3, 3]
    assert shift[1] == pytest.approx(0.8, abs=0.05)
    assert np.abs(shift[[0, 2]]).max() < 0.1


def test_directions_in_which_the_shift_is_known_are_named():
    rng = np.random.default_rng(5)
    shift = (0.6, -0.9, 0.4)
    whole = tied(walk(14, rng), rng, offset((30, -75, 95), shift)).offset
    assert whole is not None
    assert whole.known_along.shape == (3, 3)
    # A robot on a floor: it turns about its upright axis alone, along which any shift is another frame.
    upright = np.stack([offset((0, 0, angle), centre) for angle, centre in _on_a_floor(rng)])
    mounted = offset((120, 0, 0), shift)
    floor = tied(upright @ mounted, rng, mounted).offset
    assert floor is not None
    assert floor.known_along.shape == (3, 2)
    assert np.abs(floor.known_along[2]).max() < 0.05
    assert abs(floor.body_from_cam[2, 3]) < 0.05
    both = floor.then(whole)
    assert both.known_along.shape == (3, 3)
    np.testing.assert_allclose(both.known_along.T @ both.known_along, np.eye(3), atol=1e-12)
    # A turn of the axes of cameras that turn in all directions: the shift is known to be zero.
    axes = tied(walk(14, rng), rng, offset((180, 0, 0))).offset
    assert axes is not None
    assert (axes.shift_deviation, axes.known_along.shape) == (None, (3, 3))


def _on_a_floor(rng: np.random.Generator) -> list[tuple[float, np.ndarray]]:
    return [(rng.uniform(0, 360), rng.normal(size=3) * [3, 3, 0]) for _ in range(14)]


@pytest.mark.parametrize("rig", [dome, walk])
@pytest.mark.parametrize("count", [3, 6, 25])
def test_noise_is_no_offset(rig, count):
    for seed in range(4):
        rng = np.random.default_rng(seed)
        found = tied(rig(count, rng), rng, None, 0.1, 0.3)
        assert found.offset is None


@pytest.mark.parametrize("seed", [1, 2])
def test_errors_that_add_up_along_a_path_are_no_offset(seed):
    rng = np.random.default_rng(seed)
    truth = walk(40, rng)
    drifted = truth.copy()
    turns, shifts = np.cumsum(rng.normal(size=(2, 40, 3)), axis=1) * np.array([0.01, 0.03])[:, None, None]
    for pose, turn, shift in zip(drifted, turns, shifts, strict=True):
        pose[:3, :3] = rotation_of(turn) @ pose[:3, :3]
        pose[:3, 3] += shift
    assert tie(truth, drifted).offset is None


def test_lost_cameras_do_not_hide_an_offset():
    rng = np.random.default_rng(8)
    truth, expected = walk(20, rng), offset((0, 0, 90))
    given = truth @ rigid_inverse(expected)
    given[[2, 9, 15]] = given[[11, 4, 7]]
    found = tie(jitter(truth, rng, FOUND_RAD, FOUND), given)
    assert found.offset is not None
    np.testing.assert_allclose(found.offset.body_from_cam, expected, atol=1e-12)
    assert (found.weight[[2, 9, 15]] < 1e-3).all()


def test_rotation_vectors_are_scipys_at_every_angle():
    rng = np.random.default_rng(0)
    axes = rng.normal(size=(50, 3))
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    for angle in (0.0, 1e-12, 1e-6, 1.0, 3.0, np.pi - 1e-9):
        turns = Rotation.from_rotvec(angle * axes).as_matrix()
        np.testing.assert_allclose(rotation_vectors(turns), angle * axes, atol=1e-8)
        np.testing.assert_allclose([rotation_of(v) for v in rotation_vectors(turns)], turns, atol=1e-12)
