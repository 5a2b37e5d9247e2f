"""How cameras may move where some are one rigid body and some are fixed."""

from __future__ import annotations

import numpy as np
import torch

from biresnerf.arrays import Array
from biresnerf.geometry.lie import so3_exp
from biresnerf.geometry.rigid_bodies import RigidBodies
from biresnerf.refinement.adjustment.cameras import POSE, Cameras

_REPRESENTED = 1e-6  # of a common motion's length: what bodies leave of it, if they can move so


def body_columns(cameras: Cameras, bodies: RigidBodies) -> Array:
    """Derivative [6n, k] of the cameras' increments by those of the bodies that are not fixed.

    An increment of a body is a rotation vector w about the middle p of its centres, and a shift s: a camera at c gets w
    and s + w x (c - p).
    """
    moving, column = np.unique(bodies.of[~bodies.fixed], return_inverse=True)
    columns = np.zeros((len(cameras), POSE, POSE * len(moving)))
    away = cameras.centre - _middles(cameras, bodies)
    for camera, own in zip(np.flatnonzero(~bodies.fixed), POSE * column, strict=True):
        columns[camera, :, own : own + POSE] = np.eye(POSE)
        columns[camera, 3:, own : own + 3] = np.cross(np.eye(3), away[camera]).T
    return columns.reshape(POSE * len(cameras), -1)


def rigid_motion(cameras: Cameras, bodies: RigidBodies, motion: Array) -> Array:
    """The increment [n, 6] of the cameras that keeps bodies rigid, from one [n, 6] that does so to first order."""
    turn = so3_exp(torch.from_numpy(np.ascontiguousarray(motion[:, :3]))).numpy()
    away = cameras.centre - _middles(cameras, bodies)
    first_order = np.cross(motion[:, :3], away)
    exact = np.einsum("nab,nb->na", turn, away) - away
    return np.concatenate([motion[:, :3], motion[:, 3:] - first_order + exact], axis=1)


def allowed_motions(columns: Array, common: Array) -> Array:
    """Which mixtures [m, q] of common motions [6n, m] of all cameras their bodies can make."""
    if not columns.shape[1]:
        return np.zeros((common.shape[1], 0))
    left = common - columns @ np.linalg.lstsq(columns, common, rcond=None)[0]
    _, sizes, mixtures = np.linalg.svd(left, full_matrices=False)
    return np.asarray(mixtures[sizes < _REPRESENTED * np.linalg.norm(common, axis=0).max(initial=0.0)].T)


def _middles(cameras: Cameras, bodies: RigidBodies) -> Array:
    """Of each camera's body [n, 3]."""
    count = np.bincount(bodies.of)
    sums = np.stack([np.bincount(bodies.of, cameras.centre[:, a]) for a in range(3)], 1)
    return np.asarray((sums / count[:, None])[bodies.of])
