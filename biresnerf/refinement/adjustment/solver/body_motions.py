"""How cameras may move where some are one rigid body and some are fixed."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from biresnerf.arrays import Array
from biresnerf.geometry.rigid import rotation_of
from biresnerf.geometry.rigid_bodies import RigidBodies
from biresnerf.refinement.adjustment.cameras import POSE, Cameras
from biresnerf.refinement.adjustment.solver.blocks import Blocks

_REPRESENTED = 1e-6  # of a common motion's length: what bodies leave of it, if they can move so


@dataclass(frozen=True, eq=False)
class BodyMoves:
    """How the increments of cameras follow from those of the bodies that are not fixed.

    An increment of a body is a rotation vector w about the middle p of its centres, and a shift s: a camera at c gets w
    and s + w x (c - p).

    Attributes:
        of: int64 [n], each camera's body among those that move; -1 where it is fixed.
        columns: [n, 6, 6], derivative of the camera's increment by its body's.
        bodies: how many move.
    """

    of: NDArray[np.int64]
    columns: Array
    bodies: int

    @classmethod
    def among(cls, cameras: Cameras, bodies: RigidBodies) -> BodyMoves:
        moving, number = np.unique(bodies.of[~bodies.fixed], return_inverse=True)
        of = np.full(len(cameras), -1)
        of[~bodies.fixed] = number
        away = cameras.centre - _middles(cameras, bodies)
        columns = np.tile(np.eye(POSE), (len(cameras), 1, 1))
        columns[:, 3:, :3] = np.cross(np.eye(3), away[:, None]).transpose(0, 2, 1)
        return cls(of, columns, len(moving))

    def of_cameras(self, motion: Array) -> Array:
        """Increments [n, 6, ...] of cameras, from those of bodies [m, 6, ...]."""
        found = np.zeros((len(self.of), *motion.shape[1:]))
        moving = self.of >= 0
        found[moving] = np.einsum("nab,nb...->na...", self.columns[moving], motion[self.of[moving]])
        return found

    def of_bodies(self, forces: Array) -> Array:
        """Forces on bodies [m, 6, ...], from those on cameras [n, 6, ...]."""
        found = np.zeros((self.bodies, *forces.shape[1:]))
        moving = self.of >= 0
        np.add.at(found, self.of[moving], np.einsum("nab,na...->nb...", self.columns[moving], forces[moving]))
        return found

    def reduced(self, system: Blocks) -> Blocks:
        """A matrix of cameras and lenses as one of bodies and lenses."""
        of = np.concatenate([self.of, self.bodies + np.arange(system.lenses)])
        columns = np.tile(np.eye(system.values.shape[1]), (system.parts, 1, 1))
        columns[: system.cameras, :POSE, :POSE] = self.columns
        moving = (of[system.rows] >= 0) & (of[system.other] >= 0)
        rows, other = system.rows[moving], system.other[moving]
        values = columns[rows].transpose(0, 2, 1) @ system.values[moving] @ columns[other]
        one, two = of[rows], of[other]
        # The two cameras of a block below the diagonal may be of one body, or their bodies in the other order.
        within, turned = (one == two) & (rows != other), one > two
        values[within] += values[within].transpose(0, 2, 1)
        values[turned] = values[turned].transpose(0, 2, 1)
        pairs = np.minimum(one, two), np.maximum(one, two)
        return Blocks.from_pairs(self.bodies, system.lenses, *pairs, values)

    def allowed(self, common: Array) -> Array:
        """Which mixtures [m, q] of common motions [6n, m] of all cameras the bodies can make."""
        if not self.bodies:
            return np.zeros((common.shape[1], 0))
        by_camera = common.reshape(-1, POSE, common.shape[1])
        own = self.of_bodies(self.columns)
        nearest = self.of_cameras(np.asarray(np.linalg.solve(own, self.of_bodies(by_camera)), np.float64))
        left = common - nearest.reshape(common.shape)
        _, sizes, mixtures = np.linalg.svd(left, full_matrices=False)
        return np.asarray(mixtures[sizes < _REPRESENTED * np.linalg.norm(common, axis=0).max(initial=0.0)].T)


def rigid_motion(cameras: Cameras, bodies: RigidBodies, motion: Array) -> Array:
    """The increment [n, 6] of the cameras that keeps bodies rigid, from one [n, 6] that does so to first order."""
    turn = rotation_of(motion[:, :3])
    away = cameras.centre - _middles(cameras, bodies)
    first_order = np.cross(motion[:, :3], away)
    exact = np.einsum("nab,nb->na", turn, away) - away
    return np.concatenate([motion[:, :3], motion[:, 3:] - first_order + exact], axis=1)


def _middles(cameras: Cameras, bodies: RigidBodies) -> Array:
    """The middle of each camera's body [n, 3]."""
    count = np.bincount(bodies.of)
    sums = np.stack([np.bincount(bodies.of, cameras.centre[:, a]) for a in range(3)], 1)
    return np.asarray((sums / count[:, None])[bodies.of])
