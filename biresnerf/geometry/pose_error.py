"""How far estimated camera poses are from true ones, by the definitions of BARF and BAA-NGP.

Rotation error is the angle of ``R_est R_true^T``; translation error is the distance of the world-to-camera
translation vectors ``t = -R c`` (BARF prints it raw and tabulates it times 100). Seen from a camera that
looks at the world origin ``t`` hardly changes when the camera moves around it, so the error of the centres is
reported beside it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from pydantic import Field

from biresnerf.arrays import Array
from biresnerf.frozen_model import FrozenModel
from biresnerf.geometry.focus import focus_point, rms_spread
from biresnerf.geometry.similarity import Similarity, align_by_spread, align_robust, align_row_flip

# Mean camera distance of the Blender rigs that published tables are in.
_TABLE_DISTANCE = 4.0


class Spread(FrozenModel):
    """Mean, median and largest value over the cameras."""

    mean: float
    median: float
    max: float


class FrameError(FrozenModel):
    """Pose errors in one frame."""

    rotation_deg: Spread
    translation: Spread = Field(
        description="World-to-camera translation vectors, in world units, as BARF prints it."
    )
    translation_table: Spread = Field(
        description="The same times 100, the origin at the focus point and the mean camera distance at 4."
    )
    centre_percent: Spread = Field(description="Camera centres, in percent of the reference distance.")
    worst: int = Field(description="Index of the camera with the largest rotation error.")


class PoseError(FrozenModel):
    """Pose errors of a rig: after alignment by a similarity, and without."""

    cameras: int
    aligned: FrameError = Field(
        description="After BARF's similarity of the centres: least-squares rotation, ratio of the spreads as scale."
    )
    aligned_robust: FrameError = Field(description="After a similarity that outliers do not drag along.")
    own_frame: FrameError = Field(description="Without any alignment.")
    reference_distance: float = Field(description="What centre_percent is a percentage of, in world units.")
    reference: Literal["focus", "spread", "unit"] = Field(
        description="Mean distance to the focus point; where axes are parallel, the rms spread of the "
        "centres; where these are one point, one world unit."
    )


@dataclass(frozen=True, eq=False)
class CameraErrors:
    """Errors of each camera: rotation_deg [n], translation [n] and centre [n] in world units."""

    rotation_deg: Array
    translation: Array
    centre: Array


def rotation_angle_deg(rotation: Array) -> Array:
    """Angles [...] (deg, 0 to 180) of rotation matrices [..., 3, 3], to full precision at both ends."""
    rotation = np.asarray(rotation, dtype=np.float64)
    twice_sine = np.sqrt(
        (rotation[..., 2, 1] - rotation[..., 1, 2]) ** 2
        + (rotation[..., 0, 2] - rotation[..., 2, 0]) ** 2
        + (rotation[..., 1, 0] - rotation[..., 0, 1]) ** 2
    )
    twice_cosine = np.trace(rotation, axis1=-2, axis2=-1) - 1.0
    angles: Array = np.degrees(np.arctan2(twice_sine, twice_cosine))
    return angles


def rotation_between_deg(a: Array, b: Array) -> Array:
    """Angles [...] (deg, 0 to 180) between the rotations of poses a and b, [..., 3 or 4, 3 or 4], in one frame."""
    return rotation_angle_deg(np.swapaxes(a[..., :3, :3], -1, -2) @ b[..., :3, :3])


def camera_errors(estimate: Array, truth: Array) -> CameraErrors:
    """Errors of poses ``world_from_cam`` [n, 4, 4] against true ones in the same frame, without alignment."""
    estimate, truth = np.asarray(estimate, dtype=np.float64), np.asarray(truth, dtype=np.float64)
    translation = _cam_from_world_translation(estimate) - _cam_from_world_translation(truth)
    return CameraErrors(
        rotation_deg=rotation_between_deg(truth, estimate),
        translation=np.linalg.norm(translation, axis=1),
        centre=np.linalg.norm(estimate[:, :3, 3] - truth[:, :3, 3], axis=1),
    )


def pose_error(estimate: Array, truth: Array) -> PoseError:
    """Compare estimated poses with true ones.

    Args:
        estimate, truth: ``world_from_cam`` [n, 4, 4] of the same cameras in the same order, OpenCV axes.
            Lengths in the result are in units of the truth's world.

    Raises:
        ValueError: if shapes differ, there is no camera, or a number is not finite.
    """
    estimate, truth = np.asarray(estimate, dtype=np.float64), np.asarray(truth, dtype=np.float64)
    truth_from_estimate = align_by_spread(estimate, truth)
    robust_truth_from_estimate = align_robust(estimate, truth)
    _, distance, reference = _reference(truth)
    return PoseError(
        cameras=len(truth),
        aligned=_frame_error(truth_from_estimate.apply_to_poses(estimate), truth),
        aligned_robust=_frame_error(robust_truth_from_estimate.apply_to_poses(estimate), truth),
        own_frame=_frame_error(estimate, truth),
        reference_distance=distance,
        reference=reference,
    )


def paper_compat_error(estimate: Array, truth: Array) -> FrameError:
    """Errors after the alignment of BARF's and BAA-NGP's code, its flaw included (`align_row_flip`).

    Args and errors as `pose_error`.
    """
    estimate, truth = np.asarray(estimate, dtype=np.float64), np.asarray(truth, dtype=np.float64)
    return _frame_error(align_row_flip(estimate, truth).apply_to_poses(estimate), truth)


def _frame_error(moved: Array, truth: Array) -> FrameError:
    origin, distance, _ = _reference(truth)
    table_from_truth = Similarity(
        _TABLE_DISTANCE / distance, np.eye(3), -origin * (_TABLE_DISTANCE / distance)
    )
    errors = camera_errors(moved, truth)
    table = camera_errors(table_from_truth.apply_to_poses(moved), table_from_truth.apply_to_poses(truth))
    return FrameError(
        rotation_deg=_spread(errors.rotation_deg),
        translation=_spread(errors.translation),
        translation_table=_spread(100.0 * table.translation),
        centre_percent=_spread(100.0 * errors.centre / distance),
        worst=int(errors.rotation_deg.argmax()),
    )


def _reference(truth: Array) -> tuple[Array, float, Literal["focus", "spread", "unit"]]:
    """Origin and distance that make errors comparable between scenes."""
    focus = focus_point(truth)
    centres = truth[:, :3, 3]
    if focus.well_posed and focus.mean_distance > 1e-9 * max(float(np.abs(centres).max()), 1e-300):
        return focus.point, focus.mean_distance, "focus"
    middle = centres.mean(axis=0)
    spread = rms_spread(centres)
    if spread > 1e-9 * max(float(np.abs(centres).max()), 1e-300):
        return middle, spread, "spread"
    return middle, 1.0, "unit"


def _cam_from_world_translation(world_from_cam: Array) -> Array:
    translations: Array = -np.einsum("nji,nj->ni", world_from_cam[:, :3, :3], world_from_cam[:, :3, 3])
    return translations


def _spread(values: Array) -> Spread:
    return Spread(mean=float(values.mean()), median=float(np.median(values)), max=float(values.max()))
