"""Which features place cameras best: ``python -m benchmarks.method.features SET... [--size 200] [--widest 1600,3200]``.

Each SET holds true poses, which get BARF's noise (0.15). Features are found with and without affine shapes and pooled
scales, at several photo sizes and limits of their number; several numbers of each photo's likeliest pairs are matched.
Prints a JSON line for each: the seconds of seeding, the peak memory of any COLMAP so far (MiB), the number of cameras
that COLMAP placed and their errors, and the errors of all cameras adjusted to the tracks from the truth: rotation (deg)
and centre (% of the cameras' distance) after alignment.
"""

from __future__ import annotations

import argparse
import json
import resource
import tempfile
import time
from dataclasses import replace
from itertools import product
from pathlib import Path
from unittest.mock import patch

import numpy as np
from numpy.typing import NDArray

from benchmarks.method.seeding import shrunk
from benchmarks.method.track_evidence import fitted_tracks
from biresnerf.data.formats.read_dataset import read_dataset
from biresnerf.data.model.dataset import Dataset
from biresnerf.data.points.tracks import KEPT, Tracks
from biresnerf.data.seeding import map_images
from biresnerf.data.seeding.map_images import LIKELIEST
from biresnerf.data.seeding.seed_poses import Seeding, seed_poses
from biresnerf.geometry.focus import focus_point
from biresnerf.geometry.perturb import perturb_poses
from biresnerf.geometry.pose_error import camera_errors
from biresnerf.geometry.similarity import align_by_spread
from biresnerf.refinement.adjustment.adjustment import adjust_poses
from biresnerf.refinement.adjustment.evidence import PosePrior
from biresnerf.refinement.numbers.finish import EvidenceNumbers
from biresnerf.studies.scenes import with_poses

PRIOR = EvidenceNumbers().prior

Array = NDArray[np.float64]


def errors(poses: Array, truth: Array) -> tuple[float, float]:
    """Mean rotation (deg) and centre (%) errors of poses [n, 4, 4]."""
    found = camera_errors(align_by_spread(poses, truth).apply_to_poses(poses), truth)
    percent = 100 / focus_point(truth).mean_distance
    return round(float(found.rotation_deg.mean()), 4), round(percent * float(found.centre.mean()), 4)


def seeded(given: Dataset, features: dict[str, object], seed: int) -> tuple[Seeding, Tracks | None]:
    of_set = map_images.thoroughness
    with (
        tempfile.TemporaryDirectory() as folder,
        patch.object(map_images, "thoroughness", lambda *asked: {**of_set(*asked), **features}),
    ):
        seeding = seed_poses(given, seed=seed, remember=Path(folder) / "seeding.json")
        return seeding, Tracks.load(Path(folder) / KEPT, given.names)


def adjusted(truth: Dataset, tracks: Tracks) -> Array:
    """Poses [n, 4, 4] that fit the tracks, found from the truth."""
    poses = truth.world_from_cam
    prior = PosePrior.equal(poses, PRIOR, PRIOR * focus_point(poses).mean_distance)
    return adjust_poses(poses, fitted_tracks(truth, tracks), prior).world_from_cam


def measured(truth: Dataset, features: dict[str, object], noise: float, seed: int) -> dict[str, object]:
    poses = truth.world_from_cam
    given = with_poses(truth, perturb_poses(poses, noise, seed=seed))
    began = time.monotonic()
    seeding, tracks = seeded(given, features, seed)
    line: dict[str, object] = {**features, "seconds": round(time.monotonic() - began)}
    line["memory_mib"] = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss // 1024
    matched = next((c for c in seeding.candidates if c.matched.any()), None)
    if matched is not None:
        placed = matched.matched
        line |= {
            "placed": int(placed.sum()),
            "matched": errors(matched.world_from_cam[placed], poses[placed]),
        }
    if tracks is not None:
        line |= {"observations": len(tracks), "adjusted": errors(adjusted(truth, tracks), poses)}
    return line


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("sets", nargs="+", type=Path)
    parser.add_argument("--size", type=int, help="Longer side of the photos, px.")
    parser.add_argument("--every", type=int, default=1)
    parser.add_argument("--noise", type=float, default=0.15)
    parser.add_argument("--numbers", default="2048,4096", help="Features of a photo, at most.")
    parser.add_argument("--widest", default="", help="Long sides at which features are looked for, px.")
    parser.add_argument("--ways", default="thorough,plain", help="Of these, those that are tried.")
    parser.add_argument("--likeliest", default=f"{LIKELIEST}", help="Pairs that each photo chooses; 0: all.")
    parser.add_argument("--seed", type=int, default=1)
    asked = parser.parse_args()
    for path in asked.sets:
        whole = read_dataset(path)
        posed = tuple(frame for frame in whole.frames if frame.world_from_cam is not None)
        truth = replace(whole, frames=posed[:: asked.every])
        with tempfile.TemporaryDirectory(prefix="biresnerf-benchmark-") as folder:
            if asked.size:
                truth = shrunk(truth, asked.size, Path(folder))
            tried = product(
                asked.widest.split(","),
                asked.numbers.split(","),
                asked.ways.split(","),
                asked.likeliest.split(","),
            )
            for widest, number, way, likeliest in tried:
                features = {
                    "thorough": way == "thorough",
                    "most_features": int(number),
                    "likeliest": int(likeliest) or None,
                    **({"widest_image": int(widest)} if widest else {}),
                }
                line = measured(truth, features, asked.noise, asked.seed)
                print(json.dumps({"set": path.name, **line}), flush=True)


if __name__ == "__main__":
    main()
