"""What several cameras see: where to begin sampling in an open scene, and how much of a view others share.

Nothing contradicts what a single camera sees right before it. A field that puts colour there explains that camera's
photo from any pose, and hides the scene from other views. So sampling begins where other cameras look too, and a
camera whose view no other shares is suspect, however small its error.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from biresnerf.geometry.camera.camera import Intrinsics, directions_in_cam, in_view
from biresnerf.refinement.numbers.scene import FrameNumbers

WITNESSES = 2  # other cameras that must have a point in view
SPACING = 0.05  # of the distances tried, as a share of the cameras' distance
SEERS, SIDE = 24, 5  # cameras tried, and pixels of each along either side
ASKED_AT_ONCE = 64  # cameras, which settle most points where the set is large
MOST_ASKED = 512  # cameras, of each camera's view


def nearest_shared(
    unit_from_cam: NDArray[np.float64], intrinsics: Intrinsics, distance: float, numbers: FrameNumbers
) -> float:
    """The share of ``distance`` from which on enough of what cameras see is seen by two others.

    The least share where no distance reaches that: a set with so little overlap needs all of it.

    Args:
        unit_from_cam: [n, 4, 4]; noisy ones will do.
        intrinsics: of the n cameras, on the CPU.
        distance: mean distance of the cameras from the scene's centre.
    """
    matrices = torch.from_numpy(unit_from_cam[:, :3])
    seers = torch.linspace(0, len(matrices) - 1, min(SEERS, len(matrices))).round().long()
    along = (torch.arange(SIDE, dtype=torch.float64) + 0.5) / SIDE
    grid = torch.stack(torch.meshgrid(along, along, indexing="xy"), -1).reshape(-1, 2)
    shares = np.arange(numbers.nearest, numbers.farthest + SPACING / 2, SPACING)
    witnessed = np.zeros(len(shares))
    for seer in seers.tolist():
        size = torch.stack([intrinsics.width[seer], intrinsics.height[seer]]).to(grid)
        in_cam = directions_in_cam(intrinsics, torch.full((len(grid),), seer), grid * size)
        rotation, centre = matrices[seer, :, :3], matrices[seer, :, 3]
        steps = torch.from_numpy(shares)[:, None, None] * distance
        points = centre + steps * (in_cam.to(matrices) @ rotation.T)
        facing = matrices[:, :, 2] @ matrices[seer, :, 2] > 0
        facing[seer] = False
        others = torch.nonzero(facing)[:, 0].split(ASKED_AT_ONCE)
        enough = _witnessed(points.reshape(-1, 3), others, matrices, intrinsics)
        witnessed += enough.numpy().reshape(len(shares), -1).mean(1)
    reached = np.flatnonzero(witnessed / len(seers) >= numbers.witnessed)
    return float(shares[reached[0]]) if len(reached) else numbers.nearest


def shared_shares(points: Tensor, seer: Tensor, unit_from_cam: Tensor, intrinsics: Intrinsics) -> Tensor:
    """Share [k] of each set of points [k, m, 3] that lies in the view of two cameras or more beside the seer's own.

    Of large sets only cameras near the points count: to try all for each camera would take hours.

    Args:
        seer: index [k] of the camera that sees the points, or would from another pose.
        unit_from_cam: [n, 3, 4], in the frame of the points.
        intrinsics: of the n cameras.
    """
    cameras = torch.arange(len(unit_from_cam), device=points.device)
    shares = []
    for own, camera in zip(points, seer.tolist(), strict=True):
        others = _nearest(own, cameras[cameras != camera], unit_from_cam)
        shares.append(_witnessed(own, others.split(ASKED_AT_ONCE), unit_from_cam, intrinsics).float().mean())
    return torch.stack(shares)


def _nearest(points: Tensor, cameras: Tensor, unit_from_cam: Tensor) -> Tensor:
    """Of many cameras those nearest to the middle of the points."""
    if len(cameras) <= MOST_ASKED:
        return cameras
    apart = (unit_from_cam[cameras, :, 3] - points.mean(0)).square().sum(1)
    return cameras[apart.topk(MOST_ASKED, largest=False).indices]


def witnessed(points: Tensor, cameras: Tensor, unit_from_cam: Tensor, intrinsics: Intrinsics) -> Tensor:
    """Whether two or more of the cameras [c], indices into ``unit_from_cam``, have points [m, 3] in view, bool [m].

    Args:
        unit_from_cam: [n, 3, 4], in the frame of the points.
        intrinsics: of the n cameras.
    """
    # One by one, as points are many and a few cameras settle most of them.
    return _witnessed(points, cameras.split(1), unit_from_cam, intrinsics)


def _witnessed(
    points: Tensor, cameras: Iterable[Tensor], unit_from_cam: Tensor, intrinsics: Intrinsics
) -> Tensor:
    """`witnessed`, by some cameras at a time, later ones only for points that are still in doubt."""
    count = torch.zeros(len(points), dtype=torch.int64, device=points.device)
    doubtful = torch.arange(len(points), device=points.device)
    for some in cameras:
        count[doubtful] += _seen_by(some, points[doubtful], unit_from_cam, intrinsics).sum(0)
        doubtful = doubtful[count[doubtful] < WITNESSES]
        if len(doubtful) == 0:
            break
    return count >= WITNESSES


def _seen_by(cameras: Tensor, points: Tensor, unit_from_cam: Tensor, intrinsics: Intrinsics) -> Tensor:
    """Whether each of the cameras [c], indices into ``unit_from_cam``, has points [m, 3] in view, bool [c, m]."""
    matrices = unit_from_cam[cameras]
    in_cam = torch.einsum("cji,ckj->cki", matrices[:, :, :3], points[None] - matrices[:, None, :, 3])
    seen = in_view(intrinsics, cameras.repeat_interleave(len(points)), in_cam.reshape(-1, 3))
    return seen.reshape(len(cameras), len(points))
