"""Views rendered at the end to be looked at: which ones, and where in space their rays end."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
import torch
from numpy.typing import NDArray

from biresnerf.data.show.view_file import ShownView
from biresnerf.geometry.focus import rms_spread
from biresnerf.geometry.similarity import Similarity
from biresnerf.refine.optimise.joint_optimiser import JointOptimiser
from biresnerf.refine.views.evaluation import ViewScore

Points = tuple[NDArray[np.float64], NDArray[np.uint8]]  # positions [n, 3] and colours [n, 3]

POINTS_A_VIEW = 2500
OPAQUE = 0.8  # rays that end in something
REACH = (
    3.0  # distances of the cameras from the scene's middle; what lies beyond is surroundings, seen vaguely
)


def spread_views(world_from_cam: NDArray[np.float64], taken: list[int], count: int) -> list[int]:
    """Up to ``count`` views beside those ``taken``, each the farthest from all before it in place and direction.

    Args:
        world_from_cam: all poses [n, 4, 4].
    """
    centres = world_from_cam[:, :3, 3]
    place = centres / max(rms_spread(centres), 1e-300)
    where = np.concatenate([place, world_from_cam[:, :3, 2]], axis=1)
    chosen = list(taken)
    apart = np.full(len(where), np.inf)
    for view in chosen:
        apart = np.minimum(apart, np.linalg.norm(where - where[view], axis=1))
    while len(chosen) < min(len(taken) + count, len(where)):
        apart[chosen] = -1.0
        view = int(np.argmax(apart))
        chosen.append(view)
        apart = np.minimum(apart, np.linalg.norm(where - where[view], axis=1))
    return chosen[len(taken) :]


@torch.no_grad()
def surface_of(optimiser: JointOptimiser, score: ViewScore) -> Points:
    """Where rays of a rendered view end, in the unit frame, and the colours there; some 2,500 at most."""
    height, width = score.view.opacity.shape
    stride = max(1, math.ceil(math.sqrt(height * width / POINTS_A_VIEW)))
    rows, columns = np.mgrid[stride // 2 : height : stride, stride // 2 : width : stride].reshape(2, -1)
    depth, opacity = score.view.depth[rows, columns], score.view.opacity[rows, columns]
    seen = (opacity > OPAQUE) & np.isfinite(depth)
    rows, columns, depth = rows[seen], columns[seen], depth[seen]
    xy = torch.from_numpy(np.stack([columns, rows], -1) + 0.5).float().to(optimiser.device)
    index = torch.full((len(xy),), score.image, device=optimiser.device)
    matrix = optimiser.poses.matrices().detach()[score.image].float().expand(len(xy), 3, 4)
    origin, direction = (part.double().cpu().numpy() for part in optimiser.cast(matrix, index, xy))
    points = origin + depth[:, None].astype(np.float64) * direction
    near = np.linalg.norm(points, axis=1) <= REACH * optimiser.frame.distance
    colours = np.rint(255 * score.view.colour[rows, columns]).astype(np.uint8)
    return points[near], colours[near]


@dataclass
class Shown:
    """Views that were rendered, and the surface they see, in the unit frame."""

    views: list[ShownView] = field(default_factory=list)
    _positions: list[NDArray[np.float64]] = field(default_factory=list)
    _colours: list[NDArray[np.uint8]] = field(default_factory=list)

    def add(self, view: ShownView, positions: NDArray[np.float64], colours: NDArray[np.uint8]) -> None:
        """Take note of one."""
        self.views.append(view)
        self._positions.append(positions)
        self._colours.append(colours)

    def surface(self, unit_from_world: Similarity, input_from_optimised: Similarity) -> Points:
        """All points in the input's frame."""
        if not self.views:
            return np.empty((0, 3)), np.empty((0, 3), np.uint8)
        in_world = unit_from_world.inverse().apply(np.concatenate(self._positions))
        return input_from_optimised.apply(in_world), np.concatenate(self._colours)
