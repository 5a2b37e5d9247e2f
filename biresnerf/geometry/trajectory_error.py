"""Pose errors as SLAM and structure-from-motion papers define them: ATE, RPE, and the AUC of relative poses."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from biresnerf.arrays import Array
from biresnerf.frozen_model import FrozenModel
from biresnerf.geometry.pose_error import rotation_angle_deg, rotation_between_deg
from biresnerf.geometry.rigid import rigid_inverse
from biresnerf.geometry.similarity import Similarity, align_by_spread

THRESHOLDS_DEG = (0.5, 1, 3, 5, 10)
WRONG_DEG = 180.0  # what a pair counts as of which a camera was not placed, as in COLMAP's benchmark
# Two centres closer than this share of the rig's size have no direction from one to the other.
_NO_BASELINE = 1e-6


class TrajectoryError(FrozenModel):
    """Errors of a rig by definitions other than those of `PoseError`; lengths in units of the truth's world."""

    ate_rmse: float = Field(
        description="Absolute trajectory error: root mean square distance of the centres after the least-squares "
        "similarity (Umeyama, with scale)."
    )
    rpe_translation_rmse: float | None = Field(
        description="Relative pose error from each camera to the next, in the order given, after that similarity: root "
        "mean square of its translation; none of one camera."
    )
    rpe_rotation_deg_rmse: float | None = Field(description="The same of its angle.")
    auc: dict[str, float] = Field(
        description="By threshold t in degrees: area, from 0 to t and over t, under the share of camera pairs whose "
        "relative rotation and direction of translation are both within an angle. Needs no alignment; empty for one "
        "camera."
    )
    auc_all: dict[str, float] = Field(
        description="The same over all cameras of the truth: pairs with one that was not placed are wrong."
    )
    auc_covisible: dict[str, float] = Field(
        description="The same as auc over pairs that see enough common points of the truth; empty if it has none."
    )


def trajectory_error(
    estimate: Array, truth: Array, missing: int = 0, covisible: NDArray[np.bool_] | None = None
) -> TrajectoryError:
    """Errors of poses ``world_from_cam`` [n, 4, 4] against true ones of the same cameras in the same order.

    Args:
        missing: how many more cameras the truth has.
        covisible: symmetric [n, n], which cameras see the same.

    Raises:
        ValueError: if shapes differ, there is no camera, or a number is not finite.
    """
    estimate, truth = np.asarray(estimate, dtype=np.float64), np.asarray(truth, dtype=np.float64)
    aligned = _least_squares(estimate, truth).apply_to_poses(estimate)
    centres = np.linalg.norm(aligned[:, :3, 3] - truth[:, :3, 3], axis=1)
    steps = rigid_inverse(_steps(truth)) @ _steps(aligned)
    errors, n = relative_errors_deg(estimate, truth), len(truth)
    wrong = np.full(missing * (2 * n + missing - 1) // 2, WRONG_DEG)
    seen = np.zeros((n, n), bool) if covisible is None else covisible
    return TrajectoryError(
        ate_rmse=float(np.sqrt(np.mean(centres**2))),
        rpe_translation_rmse=_rms(np.linalg.norm(steps[:, :3, 3], axis=1)),
        rpe_rotation_deg_rmse=_rms(rotation_angle_deg(steps[:, :3, :3])),
        auc=_areas(errors),
        auc_all=_areas(np.concatenate((errors, wrong))),
        auc_covisible=_areas(errors[seen[np.triu_indices(n, 1)]]),
    )


def _least_squares(estimate: Array, truth: Array) -> Similarity:
    """The ``truth_from_estimate`` that leaves the least distance between centres.

    BARF's protocol takes the ratio of the rigs' sizes for the scale; its rotation is the same.
    """
    barf = align_by_spread(estimate, truth)
    a, b = estimate[:, :3, 3], truth[:, :3, 3]
    from_middle = (a - a.mean(axis=0)) @ barf.rotation.T
    along = float(np.sum((b - b.mean(axis=0)) * from_middle))
    if along <= 0.0:  # the centres coincide, or are uncorrelated
        return barf
    scale = along / float(np.sum(from_middle**2))
    return Similarity(scale, barf.rotation, b.mean(axis=0) - scale * barf.rotation @ a.mean(axis=0))


def _steps(world_from_cam: Array) -> Array:
    """Each camera's pose seen from the one before it, [n - 1, 4, 4]."""
    return rigid_inverse(world_from_cam[:-1]) @ world_from_cam[1:]


def relative_errors_deg(estimate: Array, truth: Array) -> Array:
    """For each pair of cameras [n (n - 1) / 2] the larger of the errors of its relative rotation and direction.

    Pairs with coinciding true centres have no direction; only their rotation counts.
    """
    size = float(np.ptp(truth[:, :3, 3], axis=0).max())
    found = [np.zeros(0)]
    for first in range(len(truth) - 1):  # one row of pairs at a time, to save memory
        ours = rigid_inverse(estimate[first]) @ estimate[first + 1 :]
        true = rigid_inverse(truth[first]) @ truth[first + 1 :]
        turned = rotation_between_deg(true, ours)
        apart = np.linalg.norm(true[:, :3, 3], axis=1) > _NO_BASELINE * size
        off = np.where(apart, _angle_deg(ours[:, :3, 3], true[:, :3, 3]), 0.0)
        found.append(np.maximum(turned, off))
    return np.concatenate(found)


def _angle_deg(a: Array, b: Array) -> Array:
    """Angles [n] between vectors [n, 3], to full precision; 90 degrees if either is zero."""
    across = np.linalg.norm(np.cross(a, b), axis=1)
    along = np.einsum("ni,ni->n", a, b)
    return np.where((across == 0) & (along == 0), 90.0, np.degrees(np.arctan2(across, along)))


def _areas(errors: Array) -> dict[str, float]:
    return {f"{limit:g}": area_under_recall(errors, limit) for limit in THRESHOLDS_DEG if len(errors)}


def area_under_recall(errors: Array, limit: float) -> float:
    """Area under the share of ``errors`` below x, for x from 0 to ``limit``, over ``limit``: from 0 to 1.

    The share is interpolated linearly between errors, as in structure-from-motion benchmarks.
    """
    ordered = np.concatenate(([0.0], np.sort(errors)))
    share = np.arange(len(ordered)) / len(errors)
    inside = int(np.searchsorted(ordered, limit))
    x = np.concatenate((ordered[:inside], [limit]))
    y = np.concatenate((share[:inside], [share[inside - 1]]))
    return float(np.trapezoid(y, x) / limit)


def _rms(values: Array) -> float | None:
    return float(np.sqrt(np.mean(values**2))) if len(values) else None
