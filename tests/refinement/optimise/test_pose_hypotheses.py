"""Poses tried for a lost camera: the true one, or one near enough, is among them."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from biresnerf.data.synthetic.scene import synthetic_cameras
from biresnerf.geometry.lie import so3_exp
from biresnerf.geometry.pose_error import rotation_angle_deg
from biresnerf.geometry.similarity import Similarity
from biresnerf.refinement.numbers.lost import LostNumbers
from biresnerf.refinement.optimise.pose_hypotheses import photo_distances, pose_hypotheses
from tests.refinement.tiny_scene import photos_set

VIEWS, LOST = 24, 7
TRUTH = synthetic_cameras(VIEWS, seed=3)
ALL = np.ones(VIEWS, bool)
LIKENESS = np.linalg.norm(TRUTH[:, :3, 3] - TRUTH[LOST, :3, 3], axis=1)


def turned(rotvec: list[float]) -> np.ndarray:
    matrix = np.eye(4)
    matrix[:3, :3] = so3_exp(torch.tensor(rotvec, dtype=torch.float64)).numpy()
    return matrix


def nearest_deg(hypotheses: np.ndarray, truth: np.ndarray) -> float:
    """How far the nearest hypothesis is off, in rotation or as seen from the scene, whichever is more."""
    centre = np.linalg.norm(hypotheses[:, :3, 3] - truth[:3, 3], axis=1) / np.linalg.norm(truth[:3, 3])
    turn = rotation_angle_deg(hypotheses[:, :3, :3].transpose(0, 2, 1) @ truth[:3, :3])
    return float(np.maximum(turn, np.degrees(centre)).min())


def spoiled(pose: np.ndarray) -> np.ndarray:
    poses = TRUTH.copy()
    poses[LOST] = pose
    return poses


@pytest.mark.parametrize(
    ("wrong", "within_deg"),
    [
        (TRUTH[LOST] @ np.diag([-1.0, 1, -1, 1]), 1e-6),  # looks the other way
        (TRUTH[LOST] @ np.diag([-1.0, -1, 1, 1]), 1e-6),  # stored upside down
        (TRUTH[LOST] @ turned([0, 0, np.pi / 2]), 1e-6),  # stored on its side
        (TRUTH[LOST] @ turned([0.9, -1.4, 0]), 3),  # turned away in place
        (turned(list(np.radians(30) * TRUTH[LOST, :3, 1])) @ TRUTH[LOST], 1e-6),
        (turned(list(np.radians(-45) * TRUTH[LOST, :3, 0])) @ TRUTH[LOST], 1e-6),
        (turned([0, 0, 2.5]) @ TRUTH[LOST], 35),  # far round the scene: only a similar photo tells
    ],
)
def test_the_true_pose_is_among_them_or_near(wrong, within_deg):
    poses = spoiled(wrong)
    found = pose_hypotheses(poses, poses, LOST, ALL, LIKENESS, LostNumbers())
    assert nearest_deg(found, TRUTH[LOST]) <= within_deg


def test_the_given_pose_follows_the_frame_that_the_others_have_drifted_to():
    drift = Similarity(1.1, turned([0.1, 0.3, -0.2])[:3, :3], np.array([0.2, -0.1, 0.3]))
    now = drift.apply_to_poses(TRUTH)
    wandered = now.copy()
    wandered[LOST] = now[0]
    found = pose_hypotheses(TRUTH, wandered, LOST, ALL, LIKENESS, LostNumbers())
    np.testing.assert_allclose(found[0], now[LOST], atol=1e-9)


def test_corrections_of_neighbours_are_tried():
    """All cameras were given 25 degrees off about an axis of no orbit; all but one have come home since."""
    off = turned(list(np.radians(25) * np.array([0.6, 0.48, 0.64])))
    given = TRUTH.copy()
    near = np.argsort(LIKENESS)[:12]
    given[near] = off @ TRUTH[near]
    found = pose_hypotheses(given, spoiled(given[LOST]), LOST, ALL, LIKENESS, LostNumbers())
    assert nearest_deg(found, TRUTH[LOST]) < 5


def test_cameras_that_are_not_trusted_are_not_asked():
    poses = spoiled(TRUTH[LOST] @ np.diag([-1.0, 1, -1, 1]))
    strayed = int(np.argsort(LIKENESS)[1])
    poses[strayed] = turned([0, 0, 1.234]) @ poses[strayed]
    trusted = ALL.copy()
    trusted[[LOST, strayed]] = False
    found = pose_hypotheses(TRUTH, poses, LOST, trusted, LIKENESS, LostNumbers())
    assert np.abs(found - poses[strayed]).max(axis=(1, 2)).min() > 1e-3


def test_all_are_rigid_motions_even_where_nobody_can_be_asked():
    found = pose_hypotheses(TRUTH, TRUTH, LOST, np.zeros(VIEWS, bool), LIKENESS, LostNumbers())
    rotations = found[:, :3, :3]
    np.testing.assert_allclose(
        rotations @ rotations.transpose(0, 2, 1), np.tile(np.eye(3), (len(found), 1, 1)), atol=1e-12
    )
    np.testing.assert_allclose(np.linalg.det(rotations), 1)
    assert np.isfinite(found).all()


def test_photos_are_compared_whatever_their_size():
    rng = np.random.default_rng(0)
    a, b = (rng.integers(0, 255, (32, 32, 3), dtype=np.uint8).repeat(2, 0).repeat(2, 1) for _ in range(2))
    far = photo_distances(photos_set([a, b, a[::2, ::2].copy()]))
    np.testing.assert_allclose(np.diag(far), 0, atol=1e-3)
    assert far[0, 2] < 1e-3 < far[0, 1]
    np.testing.assert_allclose(far, far.T)
