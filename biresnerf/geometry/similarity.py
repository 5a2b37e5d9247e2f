"""Similarities (scale, rotation, translation), and alignment of one camera rig with another."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from biresnerf.arrays import Array
from biresnerf.geometry.focus import rms_spread
from biresnerf.geometry.rigid import motion_of, rotation_about
from biresnerf.report import SimilarityReport

# Centres whose correlation across a line is below this share of that along it leave the turn about the line
# to the cameras' rotations. A spread of one hundredth of the length gives 1e-4.
_LINE_BELOW = 1e-4
# Centres spread by less than this share of their coordinates are one point.
_POINT_BELOW = 1e-9
# Cauchy scale in medians of the residuals.
_CAUCHY_MEDIANS = 2.0
_ROBUST_ROUNDS = 100


@dataclass(frozen=True, eq=False)
class Similarity:
    """A ``b_from_a``: ``x_in_b = scale * rotation @ x_in_a + translation``.

    Attributes:
        scale: units of b per unit of a, above zero.
        rotation: [3, 3], determinant +1.
        translation: [3], in units of b.
    """

    scale: float
    rotation: Array
    translation: Array

    def __post_init__(self) -> None:
        if not (np.isfinite(self.scale) and self.scale > 0):
            raise ValueError(f"scale must be finite and above zero, got {self.scale}")
        if np.shape(self.rotation) != (3, 3) or np.shape(self.translation) != (3,):
            raise ValueError(
                f"need [3, 3] and [3], got {np.shape(self.rotation)} and {np.shape(self.translation)}"
            )

    @classmethod
    def identity(cls) -> Similarity:
        return cls(1.0, np.eye(3), np.zeros(3))

    @classmethod
    def of(cls, report: SimilarityReport) -> Similarity:
        """The similarity that a report holds."""
        return cls(report.scale, np.array(report.rotation), np.array(report.translation))

    def report(self) -> SimilarityReport:
        """The numbers for a report."""
        rotation, translation = self.rotation.tolist(), self.translation.tolist()
        return SimilarityReport(scale=self.scale, rotation=rotation, translation=translation)

    def apply(self, x_in_a: Array) -> Array:
        """Points [..., 3] in a to points [..., 3] in b."""
        return self.scale * np.asarray(x_in_a, dtype=np.float64) @ self.rotation.T + self.translation

    def apply_to_poses(self, a_from_cam: Array) -> Array:
        """Poses [..., 4, 4] in a to poses in b: centres move as points, rotations stay rotations."""
        poses = np.asarray(a_from_cam, dtype=np.float64)
        return motion_of(self.rotation @ poses[..., :3, :3], self.apply(poses[..., :3, 3]))

    def inverse(self) -> Similarity:
        """The ``a_from_b`` of this ``b_from_a``."""
        return Similarity(
            1.0 / self.scale, self.rotation.T.copy(), -(self.rotation.T @ self.translation) / self.scale
        )

    def __matmul__(self, b_from_a: Similarity) -> Similarity:
        """``c_from_b @ b_from_a`` is ``c_from_a``."""
        return Similarity(
            self.scale * b_from_a.scale, self.rotation @ b_from_a.rotation, self.apply(b_from_a.translation)
        )


def align_by_spread(a_from_cam: Array, b_from_cam: Array) -> Similarity:
    """The ``b_from_a`` that carries the camera centres of a rig in a onto those in b, as in BARF's evaluation.

    Scale is the ratio of the root-mean-square spreads, which is not the least-squares one (`trajectory_error`
    has that); the rotation comes from the singular value decomposition of the correlation with the determinant
    kept at +1 (Umeyama 1991), so flat rigs are handled at any tilt. Where the centres leave the rotation
    undetermined, the cameras' rotations decide: about the line of collinear centres, or the whole rotation if all
    centres coincide (scale is 1 then).

    Args:
        a_from_cam, b_from_cam: poses [n, 4, 4] of the same n >= 1 cameras in the same order.

    Raises:
        ValueError: if the shapes differ from that or a number is not finite.
    """
    a, b = _rig_pair(a_from_cam, b_from_cam)
    ones = np.ones(len(a))
    return _align_weighted(a, b, ones, ones)


def align_row_flip(a_from_cam: Array, b_from_cam: Array) -> Similarity:
    """As `align_by_spread` but with the published code's handling of reflections: it negates the rotation's third row.

    That is not the best rotation: on flat rigs that are tilted in b it is wrong by tens of degrees. Only for comparison
    with numbers from BARF's or BAA-NGP's evaluation.

    Raises:
        ValueError: as `align_by_spread`.
    """
    a, b = _rig_pair(a_from_cam, b_from_cam)
    best = align_by_spread(a, b)
    from_middle_a = a[:, :3, 3] - a[:, :3, 3].mean(0)
    from_middle_b = b[:, :3, 3] - b[:, :3, 3].mean(0)
    left, _, right_t = np.linalg.svd(from_middle_b.T @ from_middle_a)
    rotation = left @ right_t
    if np.linalg.det(rotation) < 0:
        rotation[2] *= -1
    middle_b = b[:, :3, 3].mean(0)
    return Similarity(best.scale, rotation, middle_b - best.scale * rotation @ a[:, :3, 3].mean(0))


def align_robust(
    a_from_cam: Array, b_from_cam: Array, *, with_rotations: bool = False, with_scale: bool = True
) -> Similarity:
    """As `align_by_spread`, but robust to outlier cameras.

    ``with_rotations`` estimates the rotation from the cameras' rotations as well as their centres: not BARF's
    metric, but a better estimate of a frame from noisy poses. Without ``with_scale`` the scale is 1.

    Iteratively reweighted least squares with Cauchy weights; the scale is twice the median residual of each
    round, separately for centres and rotations.

    Raises:
        ValueError: as `align_by_spread`.
    """
    a, b = _rig_pair(a_from_cam, b_from_cam)
    weights_centre = weights_rotation = np.ones(len(a))
    free = {"with_rotations": with_rotations, "with_scale": with_scale}
    b_from_a = _align_weighted(a, b, weights_centre, weights_rotation, **free)
    spread = rms_spread(b[:, :3, 3])
    for _ in range(_ROBUST_ROUNDS):
        moved = b_from_a.apply_to_poses(a)
        centre_residual = np.linalg.norm(moved[:, :3, 3] - b[:, :3, 3], axis=1)
        rotation_residual = np.linalg.norm(moved[:, :3, :3] - b[:, :3, :3], axis=(1, 2))
        # Floors far below any real residual, so that an exact fit of the majority does not divide by zero.
        weights_centre = _cauchy(centre_residual, floor=1e-12 * max(spread, 1e-300))
        weights_rotation = _cauchy(rotation_residual, floor=1e-12)
        last = b_from_a
        b_from_a = _align_weighted(a, b, weights_centre, weights_rotation, **free)
        if _same(last, b_from_a, spread):
            break
    return b_from_a


def align_points(in_a: Array, in_b: Array) -> Similarity:
    """As `align_robust`, for points [n, 3]; points on a line leave the rotation about it open.

    Raises:
        ValueError: as `align_by_spread`.
    """
    upright = np.tile(np.eye(3), (len(in_a), 1, 1))
    return align_robust(motion_of(upright, in_a), motion_of(upright, in_b))


def _align_weighted(
    a: Array,
    b: Array,
    weights_centre: Array,
    weights_rotation: Array,
    *,
    with_rotations: bool = False,
    with_scale: bool = True,
) -> Similarity:
    share = weights_centre / weights_centre.sum()
    centres_a, centres_b = a[:, :3, 3], b[:, :3, 3]
    middle_a, middle_b = share @ centres_a, share @ centres_b
    from_middle_a, from_middle_b = centres_a - middle_a, centres_b - middle_b
    spread_a = float(np.sqrt(share @ (from_middle_a**2).sum(1)))
    spread_b = float(np.sqrt(share @ (from_middle_b**2).sum(1)))
    # sum of B_i A_i^T: its nearest rotation is the mean turn between the cameras of the two rigs.
    turn = np.einsum("n,nij,nkj->ik", weights_rotation / weights_rotation.sum(), b[:, :3, :3], a[:, :3, :3])
    if _is_point(spread_a, centres_a) or _is_point(spread_b, centres_b):
        scale, rotation = 1.0, nearest_rotation(turn)
    else:
        scale = spread_b / spread_a if with_scale else 1.0
        correlation = (from_middle_b.T * share) @ from_middle_a / (spread_a * spread_b)
        # Both matrices are without unit: a trace of 1 for centres that agree, of 3 for rotations that do.
        rotation = nearest_rotation(correlation + turn) if with_rotations else _rotation_of(correlation, turn)
    return Similarity(scale, rotation, middle_b - scale * rotation @ middle_a)


def _rotation_of(correlation: Array, turn: Array) -> Array:
    """Rotation maximising ``trace(rotation^T correlation)``; `turn` decides what a rank of one leaves free."""
    left, values, right_t = np.linalg.svd(correlation)
    if values[1] > _LINE_BELOW * values[0]:
        return _proper(left, right_t)
    # Complete both directions of the line to right-handed frames, then turn about the line by the angle that
    # brings the cameras closest.
    left[:, 2] *= np.linalg.det(left)
    right_t[2] *= np.linalg.det(right_t)
    about = left.T @ turn @ right_t.T
    angle = np.arctan2(about[2, 1] - about[1, 2], about[1, 1] + about[2, 2])
    rotation: Array = left @ rotation_about(0, angle) @ right_t
    return rotation


def nearest_rotation(matrix: Array) -> Array:
    """The rotations [..., 3, 3] nearest to matrices [..., 3, 3] (Frobenius norm); never a reflection."""
    left, _, right_t = np.linalg.svd(matrix)
    return _proper(left, right_t)


def _proper(left: Array, right_t: Array) -> Array:
    """The products of orthogonal matrices, the last axis between them negated where one would be a reflection."""
    between = np.ones((*left.shape[:-2], 1, 3))
    between[..., 0, 2] = np.sign(np.linalg.det(left) * np.linalg.det(right_t))
    rotation: Array = (left * between) @ right_t
    return rotation


def _is_point(spread: float, centres: Array) -> bool:
    return spread <= _POINT_BELOW * max(float(np.abs(centres).max()), 1e-300)


def _cauchy(residual: Array, floor: float) -> Array:
    scale = max(_CAUCHY_MEDIANS * float(np.median(residual)), floor)
    return 1.0 / (1.0 + (residual / scale) ** 2)


def _same(one: Similarity, other: Similarity, spread: float) -> bool:
    turned = np.abs(one.rotation - other.rotation).max()
    scaled = abs(one.scale / other.scale - 1.0)
    shifted = np.abs(one.translation - other.translation).max() / max(
        spread, float(np.abs(other.translation).max()), 1e-300
    )
    return bool(max(turned, scaled, shifted) < 1e-13)


def _rig_pair(a_from_cam: Array, b_from_cam: Array) -> tuple[Array, Array]:
    a, b = np.asarray(a_from_cam, dtype=np.float64), np.asarray(b_from_cam, dtype=np.float64)
    if a.shape != b.shape or a.ndim != 3 or a.shape[1:] != (4, 4) or len(a) == 0:
        raise ValueError(f"both rigs must have one shape [n, 4, 4] with n >= 1, got {a.shape} and {b.shape}")
    if not (np.isfinite(a).all() and np.isfinite(b).all()):
        raise ValueError("poses must be finite")
    return a, b
