"""ATE, RPE and AUC against independent computations and known perturbations."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation

from biresnerf.geometry.trajectory_error import area_under_recall, relative_errors_deg, trajectory_error
from tests.geometry.rigs import dome, jitter, similar


def by_minimisation(estimate: np.ndarray, truth: np.ndarray) -> float:
    """The least RMS distance of the centres over all similarities, found without any closed form."""
    a, b = estimate[:, :3, 3], truth[:, :3, 3]

    def rms(x: np.ndarray) -> float:
        moved = np.exp(x[0]) * Rotation.from_rotvec(x[1:4]).apply(a) + x[4:7]
        return float(np.sqrt(((moved - b) ** 2).sum(1).mean()))

    starts = [
        np.concatenate(([0.0], turn, b.mean(0))) for turn in (np.zeros(3), [0.5, 0.5, 0], [0, -0.5, 0.5])
    ]
    found = [minimize(rms, start, method="BFGS", options={"gtol": 1e-10}).fun for start in starts]
    return min(found)


def test_ate_is_the_least_rms_distance_that_any_similarity_leaves() -> None:
    rng = np.random.default_rng(0)
    truth = dome(14, rng)
    noisy = jitter(truth, rng, 0.05, 0.1)
    moved = similar(
        noisy, 1.4, Rotation.from_rotvec([0.2, -0.3, 0.1]).as_matrix(), np.array([0.3, 0.1, -0.2])
    )
    assert trajectory_error(moved, truth).ate_rmse == pytest.approx(by_minimisation(moved, truth), rel=1e-5)


def test_rpe_sees_a_step_that_is_too_long_and_not_where_the_rig_stands() -> None:
    truth = np.tile(np.eye(4), (6, 1, 1))
    truth[:, :3, 3] = [[0, 0, 0], [1, 0, 0], [2, 1, 0], [3, 0, 1], [4, 1, 0], [5, 0, 0]]
    turn = Rotation.from_euler("y", 10, degrees=True).as_matrix()
    estimate = truth.copy()
    estimate[3:, :3, :3] = turn  # one relative rotation of five is 10 degrees off
    error = trajectory_error(similar(estimate, 7.0, Rotation.random(rng=1).as_matrix(), np.ones(3)), truth)
    assert error.rpe_rotation_deg_rmse == pytest.approx(10 / np.sqrt(5))
    # Turned cameras see the way to the next one from another side: by 2 sin(5 deg) of its length.
    x, _, z = np.diff(truth[:, :3, 3], axis=0).T
    off = np.where(np.arange(5) >= 3, 2 * np.sin(np.radians(5)) * np.hypot(x, z), 0.0)
    assert error.rpe_translation_rmse == pytest.approx(np.sqrt(np.mean(off**2)))


def test_auc_integrates_the_recall_curve() -> None:
    errors = np.random.default_rng(2).gamma(2.0, 2.0, 500)
    for limit in (1.0, 3.0, 5.0, 10.0):
        x = np.linspace(0, limit, 400_001)
        recall = np.interp(x, np.concatenate(([0], np.sort(errors))), np.arange(501) / 500)
        below = np.sort(errors)[errors[np.argsort(errors)] < limit]
        # After the last error below the limit the share stays as it is.
        recall = np.where(x > below.max(), len(below) / 500, recall)
        assert area_under_recall(errors, limit) == pytest.approx(np.trapezoid(recall, x) / limit, abs=1e-6)
    assert area_under_recall(np.zeros(4), 1) == 1.0
    assert area_under_recall(np.full(4, 50.0), 10) == 0.0


def test_relative_errors_are_those_of_pairs_in_any_frame() -> None:
    rng = np.random.default_rng(3)
    truth = dome(7, rng)
    estimate = jitter(truth, rng, 0.1, 0.2)
    moved = similar(estimate, 0.3, Rotation.random(rng=4).as_matrix(), np.array([5.0, 1, 2]))
    expected = []
    for i in range(7):
        for j in range(i + 1, 7):
            ours, true = (np.linalg.inv(rig[i]) @ rig[j] for rig in (estimate, truth))
            turned = Rotation.from_matrix(true[:3, :3].T @ ours[:3, :3]).magnitude()
            a, b = ours[:3, 3], true[:3, 3]
            off = np.arccos(a @ b / np.linalg.norm(a) / np.linalg.norm(b))
            expected.append(np.degrees(max(turned, off)))
    assert relative_errors_deg(moved, truth) == pytest.approx(np.array(expected), abs=1e-6)


def test_cameras_at_one_place_are_judged_by_their_rotations_and_one_camera_has_no_pairs() -> None:
    truth = np.tile(np.eye(4), (3, 1, 1))
    truth[2, 0, 3] = 1.0
    assert relative_errors_deg(truth, truth) == pytest.approx(np.zeros(3))
    one = trajectory_error(truth[:1], truth[:1])
    assert (one.auc_all, one.auc_covisible) == ({}, {})
    assert (one.auc, one.rpe_translation_rmse, one.rpe_rotation_deg_rmse) == ({}, None, None)


def test_cameras_that_were_not_placed_make_all_their_pairs_wrong_and_covisible_pairs_are_judged_alone() -> (
    None
):
    rng = np.random.default_rng(5)
    truth = dome(6, rng)
    estimate = truth.copy()
    estimate[5, :3, :3] = truth[5, :3, :3] @ Rotation.from_euler("z", 30, degrees=True).as_matrix()
    covisible = np.ones((6, 6), bool)
    covisible[5], covisible[:, 5] = False, False
    error = trajectory_error(estimate, truth, missing=4, covisible=covisible)
    for limit in ("0.5", "1", "3", "5"):
        assert error.auc[limit] == pytest.approx(10 / 15, abs=1e-5)
        assert error.auc_all[limit] == pytest.approx(10 / 45, abs=1e-5)
        assert error.auc_covisible[limit] == pytest.approx(1.0, abs=1e-5)
