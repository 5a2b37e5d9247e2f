"""Cameras that must not move, and cameras that move together as one rigid body.

A fixed camera ends exactly where it began and determines the frame of the result. The cameras of one moment of a rig
share one motion, so their relative poses stay.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from biresnerf.geometry.similarity import Similarity, align_robust

# Fixed centres nearer to each other than this share of the rig's spread leave its scale open.
_APART = 1e-6


@dataclass(frozen=True, eq=False)
class RigidBodies:
    """Which cameras are one body.

    Attributes:
        of: int64 [n], each camera's body, numbered from 0 without gaps.
        fixed: bool [n]; a body's cameras are all fixed or none.
    """

    of: NDArray[np.int64]
    fixed: NDArray[np.bool_]

    @classmethod
    def free(cls, count: int) -> RigidBodies:
        """Every camera a body of its own, none fixed."""
        return cls(np.arange(count), np.zeros(count, dtype=np.bool_))

    @property
    def shared(self) -> list[NDArray[np.int64]]:
        """The cameras of each body that has several."""
        by_body, count = np.argsort(self.of, kind="stable"), np.bincount(self.of)
        end = np.cumsum(count)
        return [by_body[end[body] - count[body] : end[body]] for body in np.flatnonzero(count > 1)]

    @property
    def alone(self) -> NDArray[np.bool_]:
        """Cameras [n] that may move whatever the others do."""
        return np.asarray(~self.fixed & (np.bincount(self.of)[self.of] == 1))

    @property
    def tied(self) -> bool:
        """Whether any camera cannot move independently."""
        return not self.alone.all()

    def held(self, world_from_cam: NDArray[np.float64], given: NDArray[np.float64]) -> NDArray[np.float64]:
        """Poses [n, 4, 4] with every body's relative poses, and all fixed poses, as in ``given``.

        If fixed cameras stand elsewhere, the whole set is first aligned to them, so that the others keep their place
        relative to them.
        """
        poses = np.array(world_from_cam, dtype=np.float64)
        if self.fixed.any() and not np.array_equal(poses[self.fixed], given[self.fixed]):
            carried = align_robust(poses[self.fixed], given[self.fixed], with_rotations=True)
            poses = carried.apply_to_poses(poses)
        return self.restored(poses, given)

    def restored(
        self, world_from_cam: NDArray[np.float64], given: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Poses [n, 4, 4] without rounding errors: bodies as in ``given`` to float64, fixed ones exactly."""
        poses = world_from_cam.copy()
        for group in self.shared:
            if not np.array_equal(poses[group], given[group]):
                moved = align_robust(given[group], poses[group], with_rotations=True, with_scale=False)
                poses[group] = moved.apply_to_poses(given[group])
        poses[self.fixed] = given[self.fixed]
        return poses

    def input_from_optimised(
        self, optimised: NDArray[np.float64], given: NDArray[np.float64]
    ) -> Similarity | None:
        """The similarity from optimised poses [n, 4, 4] to the input's frame, as far as bodies determine it.

        None where they determine nothing of it. Fixed cameras have not moved, so the frame is the input's already; a
        single one leaves the scale about its centre free. Rigs determine the scale, unless their cameras share one
        centre.
        """
        if self.fixed.any():
            centres = given[self.fixed][:, :3, 3]
            if self._keep_scale(given) or _apart(centres, given):
                return Similarity.identity()
            scale = _scale_about(centres[0], optimised[:, :3, 3], given[:, :3, 3])
            return Similarity(scale, np.eye(3), (1.0 - scale) * centres[0])
        if self._keep_scale(given):
            return align_robust(optimised, given, with_rotations=True, with_scale=False)
        return None

    def _keep_scale(self, given: NDArray[np.float64]) -> bool:
        """Whether some body's cameras stand apart: the views of a panorama do not."""
        return any(_apart(given[group][:, :3, 3], given) for group in self.shared)


def _apart(centres: NDArray[np.float64], poses: NDArray[np.float64]) -> bool:
    """Whether centres [m, 3] of some of the poses [n, 4, 4] differ."""
    spread = np.linalg.norm(poses[:, :3, 3] - poses[:, :3, 3].mean(0), axis=1).mean()
    return bool(np.linalg.norm(centres - centres[0], axis=1).max() > _APART * spread)


def _scale_about(centre: NDArray[np.float64], a: NDArray[np.float64], b: NDArray[np.float64]) -> float:
    """Median ratio of the distances of points b and a [n, 3] from ``centre``."""
    far_a, far_b = np.linalg.norm(a - centre, axis=1), np.linalg.norm(b - centre, axis=1)
    some = (far_a > _APART * far_a.max(initial=0.0)) & (far_b > 0)
    return float(np.median(far_b[some] / far_a[some])) if some.any() else 1.0
