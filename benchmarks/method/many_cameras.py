"""How long the adjustment of many cameras takes: ``python -m benchmarks.method.many_cameras 250 500 1000``.

Cameras stand on a dome and look at points within it; each point is seen by six of them, half a pixel off. The poses to
start from are a tenth of a degree off. Prints a row for each number of cameras: unknowns, seconds, the mean rotation
error before and after, and the largest memory so far.
"""

from __future__ import annotations

import argparse
import time

import numpy as np
import torch
from numpy.typing import NDArray

from biresnerf.data.points.tracks import Tracks
from biresnerf.data.synthetic.scene import synthetic_cameras
from biresnerf.geometry.camera.camera import Intrinsics, project
from biresnerf.geometry.camera.camera_models import Camera
from biresnerf.geometry.perturb import perturb_poses
from biresnerf.geometry.pose_error import camera_errors
from biresnerf.geometry.similarity import align_by_spread
from biresnerf.refinement.adjustment.adjustment import adjust_poses
from biresnerf.refinement.adjustment.evidence import Evidence, PosePrior
from biresnerf.refinement.numbers.finish import EvidenceNumbers
from biresnerf.studies.run_cell import peak_memory_bytes

PRIOR = EvidenceNumbers().prior

Array = NDArray[np.float64]

POINTS, SEEN_BY, NOISE_PX, OFF = 7000, 6, 0.5, 0.002
CAMERA = Camera("PINHOLE", 400, 400, (500.0, 500.0, 200.0, 200.0))


def observations(world_from_cam: Array, intrinsics: Intrinsics, rng: np.random.Generator) -> Tracks:
    """Of points within the dome."""
    points = rng.uniform(-0.8, 0.8, (POINTS, 3))
    point = np.repeat(np.arange(POINTS), SEEN_BY)
    image = np.concatenate([np.sort(rng.permutation(len(world_from_cam))[:SEEN_BY]) for _ in points])
    poses = world_from_cam[image]
    in_cam = np.einsum("mji,mj->mi", poses[:, :3, :3], points[point] - poses[:, :3, 3])
    xy = project(intrinsics, torch.from_numpy(image), torch.from_numpy(in_cam)).numpy()
    return Tracks(point, image, xy + rng.normal(0, NOISE_PX, xy.shape))


def row(count: int) -> str:
    """Of so many cameras."""
    rng = np.random.default_rng(0)
    truth = synthetic_cameras(count, seed=1)
    intrinsics = Intrinsics.from_cameras([CAMERA] * count)
    evidence = Evidence(intrinsics, observations(truth, intrinsics, rng))
    start = perturb_poses(truth, OFF, seed=1)
    distance = float(np.linalg.norm(truth[:, :3, 3], axis=1).mean())
    started = time.monotonic()
    found = adjust_poses(start, evidence, PosePrior.equal(start, PRIOR, PRIOR * distance))
    seconds = time.monotonic() - started
    before, after = (
        camera_errors(align_by_spread(poses, truth).apply_to_poses(poses), truth).rotation_deg.mean()
        for poses in (start, found.world_from_cam)
    )
    memory = peak_memory_bytes() / 1e9
    return f"| {count} | {6 * count} | {seconds:.0f} s | {before:.3f}° | {after:.3f}° | {memory:.1f} GB |"


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("cameras", type=int, nargs="+")
    print("| cameras | unknowns | time | error before | after | memory |\n|---|---|---|---|---|---|")
    for count in parser.parse_args().cameras:
        print(row(count), flush=True)


if __name__ == "__main__":
    main()
