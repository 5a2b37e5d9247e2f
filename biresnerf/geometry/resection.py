"""A camera's pose from known points: three at a time, robustly.

The three-point problem is solved after Grunert (1841) in the form of Haralick et al., "Review and analysis of solutions
of the three point perspective pose estimation problem" (IJCV 1994): a quartic in the ratio of two distances. Consensus
is that of RANSAC (Fischler and Bolles 1981), all samples at once, with MSAC's bounded cost (Torr and Zisserman 2000).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from biresnerf.arrays import Array
from biresnerf.geometry.rigid import motion_of, rotation_of
from biresnerf.geometry.similarity import nearest_rotation

SAMPLES = 512  # of three points: with half of them wrong, one in eight is good
LEAST_POINTS = 6  # that must agree: three fit any camera, and a fourth now and then
REFINING_STEPS = 15
_REAL = 1e-4  # of a root's imaginary part, relative to its size: noise makes double roots complex


@dataclass(frozen=True, eq=False)
class Resection:
    """A camera's pose.

    Attributes:
        world_from_cam: [4, 4].
        inliers: bool [m], which points agree with it.
    """

    world_from_cam: Array
    inliers: NDArray[np.bool_]


def resect(points: Array, rays: Array, bound: float, seed: int = 0) -> Resection | None:
    """The pose that most points agree with, fitted to those; None where fewer than `LEAST_POINTS` do.

    Args:
        points: [m, 3] in the world; some may be wrong.
        rays: [m, 3], the unit directions in which the camera sees them, in its axes.
        bound: radians between a ray and its point up to which they agree.
        seed: of the samples.
    """
    if len(points) < LEAST_POINTS:
        return None
    rng = np.random.default_rng(seed)
    samples = rng.random((SAMPLES, len(points))).argpartition(3, axis=1)[:, :3]
    rotations, centres = three_point_poses(points[samples], rays[samples])
    if len(centres) == 0:
        return None
    costs = np.array(
        [
            np.minimum((_angles(points, rays, r, c) / bound) ** 2, 1.0).sum()
            for r, c in zip(rotations, centres, strict=True)
        ]
    )
    rotation, centre = rotations[costs.argmin()], centres[costs.argmin()]
    inliers = _angles(points, rays, rotation, centre) < bound
    for _ in range(2):
        if inliers.sum() < LEAST_POINTS:
            return None
        rotation, centre = _refined(points[inliers], rays[inliers], rotation, centre, bound)
        inliers = _angles(points, rays, rotation, centre) < bound
    if inliers.sum() < LEAST_POINTS or not np.isfinite(centre).all():
        return None
    return Resection(motion_of(rotation, centre), inliers)


def three_point_poses(points: Array, rays: Array) -> tuple[Array, Array]:
    """Rotations [s, 3, 3] (world from cam) and centres [s, 3] that see three points along three rays; up to four each.

    Args:
        points, rays: [k, 3, 3], three of each sample; rays of unit length.
    """
    a2 = ((points[:, 1] - points[:, 2]) ** 2).sum(1)
    b2 = ((points[:, 0] - points[:, 2]) ** 2).sum(1)
    c2 = ((points[:, 0] - points[:, 1]) ** 2).sum(1)
    apart = np.minimum(np.minimum(a2, b2), c2) > 1e-18 * np.maximum(np.maximum(a2, b2), c2)
    points, rays, a2, b2, c2 = (values[apart] for values in (points, rays, a2, b2, c2))
    cosines = [(rays[:, i] * rays[:, j]).sum(1) for i, j in ((1, 2), (0, 2), (0, 1))]
    owner, ratio = _real_roots(_grunert(a2, b2, c2, *cosines))
    points, rays, a2, b2, c2 = (values[owner] for values in (points, rays, a2, b2, c2))
    ca, cb, cg = (cosine[owner] for cosine in cosines)
    k = (a2 - c2) / b2
    with np.errstate(divide="ignore", invalid="ignore"):
        other = ((k - 1) * ratio**2 - 2 * k * cb * ratio + 1 + k) / (2 * (cg - ratio * ca))
        first = np.sqrt(b2 / (1 + ratio**2 - 2 * ratio * cb))
    distances = np.stack([first, other * first, ratio * first], 1)
    good = np.isfinite(distances).all(1) & (distances > 0).all(1)
    return _carried(points[good], distances[good, :, None] * rays[good])


def _grunert(a2: Array, b2: Array, c2: Array, ca: Array, cb: Array, cg: Array) -> Array:
    """Coefficients [k, 5] of the quartic in (third distance / first distance), the highest power first.

    Args:
        a2, b2, c2: squared distances [k] of points 2-3, 1-3 and 1-2.
        ca, cb, cg: cosines [k] of the angles between the rays of the same pairs.
    """
    d, s = (a2 - c2) / b2, (a2 + c2) / b2
    ra, rc = a2 / b2, c2 / b2
    return np.stack(
        [
            (d - 1) ** 2 - 4 * rc * ca**2,
            4 * (d * (1 - d) * cb - (1 - s) * ca * cg + 2 * rc * ca**2 * cb),
            2
            * (
                d**2
                - 1
                + 2 * d**2 * cb**2
                + 2 * (1 - rc) * ca**2
                - 4 * s * ca * cb * cg
                + 2 * (1 - ra) * cg**2
            ),
            4 * (-d * (1 + d) * cb + 2 * ra * cg**2 * cb - (1 - s) * ca * cg),
            (1 + d) ** 2 - 4 * ra * cg**2,
        ],
        1,
    )


def _real_roots(coefficients: Array) -> tuple[NDArray[np.int64], Array]:
    """Positive real roots of polynomials [k, 5]: which polynomial each is of, and the roots."""
    leading = np.abs(coefficients[:, :1]) > 1e-12 * np.abs(coefficients).max(1, keepdims=True)
    rows = np.flatnonzero(leading[:, 0] & np.isfinite(coefficients).all(1))
    companion = np.zeros((len(rows), 4, 4))
    companion[:, 0] = -coefficients[rows, 1:] / coefficients[rows, :1]
    companion[:, [1, 2, 3], [0, 1, 2]] = 1.0
    roots = np.linalg.eigvals(companion)
    real = (np.abs(roots.imag) <= _REAL * np.abs(roots)) & (roots.real > 0)
    at, which = np.nonzero(real)
    return rows[at].astype(np.int64), np.asarray(roots.real[at, which], np.float64)


def _carried(points: Array, in_cam: Array) -> tuple[Array, Array]:
    """The rotations [s, 3, 3] and centres [s, 3] that carry points of the camera [s, 3, 3] onto those of the world."""
    middle, middle_in_cam = points.mean(1), in_cam.mean(1)
    across = (points - middle[:, None]).transpose(0, 2, 1) @ (in_cam - middle_in_cam[:, None])
    rotation = nearest_rotation(across)
    return rotation, middle - (rotation @ middle_in_cam[:, :, None])[:, :, 0]


def _angles(points: Array, rays: Array, rotation: Array, centre: Array) -> Array:
    """Radians [m] between each ray and its point, as a camera there sees it."""
    towards = (points - centre) @ rotation
    cross = np.linalg.norm(np.cross(towards, rays), axis=1)
    angles: Array = np.arctan2(cross, (towards * rays).sum(1))
    return angles


def _refined(points: Array, rays: Array, rotation: Array, centre: Array, bound: float) -> tuple[Array, Array]:
    """Gauss-Newton on the angles between rays and points, less weight to those near the bound (Geman-McClure)."""
    for _ in range(REFINING_STEPS):
        towards = (points - centre) @ rotation
        length = np.maximum(np.linalg.norm(towards, axis=1), 1e-300)
        seen = towards / length[:, None]
        residual = seen - rays
        weight = 1 / (1 + (residual**2).sum(1) / bound**2) ** 2
        flat = (np.eye(3) - seen[:, :, None] * seen[:, None, :]) / length[:, None, None]
        jacobian = np.concatenate([flat @ np.cross(np.eye(3), towards[:, None]), -flat], axis=2)
        system = np.einsum("m,mij,mik->jk", weight, jacobian, jacobian)
        right = np.einsum("m,mij,mi->j", weight, jacobian, residual)
        try:
            step = -np.linalg.solve(system + 1e-12 * np.trace(system) * np.eye(6), right)
        except np.linalg.LinAlgError:
            break
        centre = centre + rotation @ step[3:]
        rotation = rotation @ rotation_of(step[:3])
        if np.linalg.norm(step[:3]) < 1e-12:
            break
    return rotation, centre
