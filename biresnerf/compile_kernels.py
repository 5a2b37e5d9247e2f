"""Compile all CPU kernels, or load them from Numba's cache: `python -m biresnerf.compile_kernels`.

Run at install time, it keeps a minute and a half of compilation off the first refinement.
"""

from __future__ import annotations

import logging
import time

import numpy as np
import torch

from biresnerf.data.points.tracks import Tracks
from biresnerf.field.backends import directions_for
from biresnerf.field.cpu.compile_kernels import compile_field_kernels
from biresnerf.geometry.camera.camera import Intrinsics
from biresnerf.geometry.camera.camera_models import Camera
from biresnerf.refinement.adjustment.adjustment import adjust_poses, misfit
from biresnerf.refinement.adjustment.evidence import Evidence, NoiseLevels, PatchPhotos, PosePrior
from biresnerf.refinement.adjustment.patch_points import Surfaces, find_patches
from biresnerf.refinement.kernels.batch_errors import add_errors
from biresnerf.refinement.kernels.draw_pixels import draw_pixels
from biresnerf.refinement.optimise.cast_rays import cast_rays, viewing_directions
from biresnerf.refinement.optimise.pixel_chances import PixelChances
from biresnerf.refinement.parameters.pose_parameters import PoseParameters

logger = logging.getLogger(__name__)
SLOW_S = 3.0  # loading from the cache takes a fraction of this
SIZE, BASELINE = 32, 0.125  # px, and as a share of the distance to the scene: four pixels


def compile_kernels(*, field: bool = True) -> float:
    """Every kernel of the adjustment, and of the field unless that runs elsewhere. Returns the seconds it took."""
    started = time.monotonic()
    if field:
        compile_field_kernels()
        _cast_one_ray()
    _adjust_two_cameras()
    seconds = time.monotonic() - started
    if seconds > SLOW_S:
        logger.info("compiled the CPU kernels in %.0f s; later runs load them from the cache", seconds)
    return seconds


def _cast_one_ray() -> None:
    """One pixel of one photo, on the way a step takes."""
    cpu = torch.device("cpu")
    photo, one, nowhere = np.zeros((1, 3), np.uint8), np.zeros(1, np.int64), np.zeros((1, 2), np.float32)
    colour, weight = np.zeros((1, 3), np.float32), np.zeros(1, np.float32)
    chances = PixelChances.of([photo[None]], [(1, 1)], [None], 0.0, cpu).arrays()
    draw_pixels(
        weight, nowhere, one, 1, chances, np.ones((1, 2), np.int64), one, photo, one, nowhere, colour, weight
    )
    add_errors(one, colour, colour, weight, weight, np.zeros((1, 3), np.float32))
    camera = torch.zeros(1, dtype=torch.int64)
    lens = Intrinsics.from_cameras([Camera("PINHOLE", SIZE, SIZE, (SIZE, SIZE, SIZE / 2, SIZE / 2))])
    in_cam = viewing_directions(directions_for(cpu), lens, camera, torch.ones(1, 2))
    _, direction = cast_rays(PoseParameters(torch.eye(4)[None], 1.0, cpu).matrices(), camera, in_cam)
    direction.sum().backward()


def _adjust_two_cameras() -> None:
    """Two cameras side by side look at a wall of vertical waves, on which points are tracked."""
    poses = np.tile(np.eye(4), (2, 1, 1))
    poses[1, 0, 3] = BASELINE
    intrinsics = Intrinsics.from_cameras(
        [Camera("PINHOLE", SIZE, SIZE, (SIZE, SIZE, SIZE / 2, SIZE / 2))] * 2
    )
    x, y = np.meshgrid(*[(np.arange(SIZE) + 0.5) / SIZE - 0.5] * 2)
    photos = [np.repeat(0.5 + 0.4 * np.sin(20 * (x + shift))[..., None], 3, 2) for shift in (0.0, BASELINE)]
    seen = np.ones((SIZE, SIZE))
    surfaces = Surfaces([np.sqrt(1 + x**2 + y**2)] * 2, [seen] * 2, [seen > 0] * 2)
    patches = find_patches(
        poses, intrinsics, PatchPhotos.stacked([p.astype(np.float32) for p in photos]), surfaces, 8
    )
    left = np.stack(np.meshgrid(*[np.linspace(8.0, 24.0, 6)] * 2), 2).reshape(-1, 2)
    xy = np.stack([left, left - [SIZE * BASELINE, 0]], 1).reshape(-1, 2)
    tracks = Tracks(np.repeat(np.arange(len(left)), 2), np.tile(np.arange(2), len(left)), xy)
    evidence = Evidence(intrinsics, tracks, patches)
    adjust_poses(poses, evidence, PosePrior.equal(poses, 0.02, 0.02))
    misfit(poses, evidence, NoiseLevels())


if __name__ == "__main__":
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    compile_kernels()
