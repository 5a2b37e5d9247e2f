"""Views rendered at the end for people to look at: which ones, and where in space their rays end."""

from __future__ import annotations

import math

import numpy as np
import torch
from numpy.typing import NDArray

from biresnerf.geometry.focus import rms_spread
from biresnerf.refinement.optimise.renderer import Renderer
from biresnerf.refinement.views.evaluation import ViewScore

Points = tuple[NDArray[np.float64], NDArray[np.uint8]]  # positions [n, 3] and colours [n, 3]

POINTS_A_VIEW = 2500
OPAQUE = 0.8  # rays that end in something
# In distances of the cameras from the scene's centre; the surroundings beyond are too vague to show.
REACH = 3.0


def spread_views(world_from_cam: NDArray[np.float64], chosen: list[int], count: int) -> list[int]:
    """Up to ``count`` views beside the ``chosen``, each the farthest from all before it in place and direction.

    Args:
        world_from_cam: all poses [n, 4, 4].
    """
    centres = world_from_cam[:, :3, 3]
    place = centres / max(rms_spread(centres), 1e-300)
    where = np.concatenate([place, world_from_cam[:, :3, 2]], axis=1)
    views = list(chosen)
    apart = np.full(len(where), np.inf)
    for view in views:
        apart = np.minimum(apart, np.linalg.norm(where - where[view], axis=1))
    while len(views) < min(len(chosen) + count, len(where)):
        apart[views] = -1.0
        view = int(np.argmax(apart))
        views.append(view)
        apart = np.minimum(apart, np.linalg.norm(where - where[view], axis=1))
    return views[len(chosen) :]


@torch.no_grad()
def surface_of(renderer: Renderer, score: ViewScore) -> Points:
    """Where rays of a rendered view end, in the unit frame, and the colours there; some 2,500 at most."""
    height, width = score.view.opacity.shape
    stride = max(1, math.ceil(math.sqrt(height * width / POINTS_A_VIEW)))
    rows, columns = np.mgrid[stride // 2 : height : stride, stride // 2 : width : stride].reshape(2, -1)
    depth, opacity = score.view.depth[rows, columns], score.view.opacity[rows, columns]
    seen = (opacity > OPAQUE) & np.isfinite(depth)
    rows, columns, depth = rows[seen], columns[seen], depth[seen]
    xy = torch.from_numpy(np.stack([columns, rows], -1) + 0.5).float().to(renderer.device)
    index = torch.full((len(xy),), score.image, device=renderer.device)
    matrix = renderer.joint.poses.matrices().detach()[score.image].float().expand(len(xy), 3, 4)
    origin, direction = (part.double().cpu().numpy() for part in renderer.cast(matrix, index, xy))
    points = origin + depth[:, None].astype(np.float64) * direction
    near = np.linalg.norm(points, axis=1) <= REACH * renderer.joint.frame.distance
    colours = np.rint(255 * score.view.colour[rows, columns]).astype(np.uint8)
    return points[near], colours[near]
