"""How near the cameras sampling begins in an open scene: where others look, too.

What a single camera sees right before it nobody can contradict. A field that puts colour there explains that camera's
photo from any pose, and hides the scene from views that it was not shown. Cameras across the scene do not help: it
lies between.
"""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray

from biresnerf.geometry.camera.camera import Intrinsics, directions_in_cam, in_view

WITNESSES = 2  # other cameras, looking less than a right angle elsewhere, that must have a point in view
WATCHED = 0.8  # of what cameras see at a distance must be so
# Distances looked at, as shares of the cameras' distance. Noisy poses share less: beyond 0.5 scenes may begin.
NEAREST, FARTHEST, SPACING = 0.1, 0.5, 0.05
SEERS, SIDE = 24, 5  # cameras that are asked, and pixels of each along either side


def watched_from(unit_from_cam: NDArray[np.float64], intrinsics: Intrinsics, distance: float) -> float:
    """The share of ``distance`` from which on `WATCHED` of what cameras see is seen by two others.

    `NEAREST` where that is nowhere so: a set that shares so little needs all it has.

    Args:
        unit_from_cam: [n, 4, 4]; noisy ones will do.
        intrinsics: of the n cameras, on the CPU.
        distance: mean distance of the cameras from the scene's centre.
    """
    matrices = torch.from_numpy(unit_from_cam[:, :3])
    seers = torch.linspace(0, len(matrices) - 1, min(SEERS, len(matrices))).round().long()
    along = (torch.arange(SIDE, dtype=torch.float64) + 0.5) / SIDE
    grid = torch.stack(torch.meshgrid(along, along, indexing="xy"), -1).reshape(-1, 2)
    shares = np.arange(NEAREST, FARTHEST + SPACING / 2, SPACING)
    watched = np.zeros(len(shares))
    for seer in seers.tolist():
        size = torch.stack([intrinsics.width[seer], intrinsics.height[seer]]).to(grid)
        in_cam = directions_in_cam(intrinsics, torch.full((len(grid),), seer), grid * size)
        rotation, centre = matrices[seer, :, :3], matrices[seer, :, 3]
        steps = torch.from_numpy(shares)[:, None, None] * distance
        points = centre + steps * (in_cam.to(matrices) @ rotation.T)
        watched += (
            _witnessed(points.reshape(-1, 3), seer, matrices, intrinsics).reshape(len(shares), -1).mean(1)
        )
    enough = np.flatnonzero(watched / len(seers) >= WATCHED)
    return float(shares[enough[0]]) if len(enough) else NEAREST


def _witnessed(
    points: torch.Tensor, seer: int, matrices: torch.Tensor, intrinsics: Intrinsics
) -> NDArray[np.bool_]:
    """Which of the points [k, 3] that camera `seer` sees have enough witnesses, bool [k]."""
    facing = matrices[:, :, 2] @ matrices[seer, :, 2] > 0
    facing[seer] = False
    others = torch.nonzero(facing)[:, 0]
    apart = points[None] - matrices[others, None, :, 3]
    in_cam = torch.einsum("cji,ckj->cki", matrices[others, :, :3], apart)
    seen = in_view(intrinsics, others.repeat_interleave(len(points)), in_cam.reshape(-1, 3))
    enough: NDArray[np.bool_] = (seen.reshape(len(others), len(points)).sum(0) >= WITNESSES).numpy()
    return enough
