"""What the input's poses add to feature matches: ``python -m benchmarks.method.input_prior SET...``.

Each SET holds true poses. Cameras are adjusted to all of its tracks and to a few, without and with the input's poses as
a prior, at several factors of their deviations. The input has random errors, or is COLMAP's model. Prints a JSON line
for each: mean rotation errors (deg) after alignment.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from unittest.mock import patch

import numpy as np
import torch
from numpy.typing import NDArray

from benchmarks.method.honesty import without_poses
from benchmarks.method.track_evidence import fitted_tracks
from biresnerf.data.formats.read_dataset import read_dataset
from biresnerf.data.model.dataset import Dataset
from biresnerf.data.points.tracks import KEPT, Tracks
from biresnerf.data.seeding.seed_poses import seed_poses
from biresnerf.geometry.focus import focus_point
from biresnerf.geometry.lie import so3_exp
from biresnerf.geometry.pose_error import camera_errors
from biresnerf.geometry.similarity import align_by_spread
from biresnerf.refinement.adjustment.adjustment import adjust_poses
from biresnerf.refinement.adjustment.evidence import PosePrior
from biresnerf.refinement.finish import given_poses as room
from biresnerf.refinement.numbers.finish import EvidenceNumbers

PRIOR = EvidenceNumbers().prior

Array = NDArray[np.float64]

ERRORS = (0.0, 0.001, 0.005, 0.02)  # of the input: rad, and shares of the cameras' distance
FACTORS = (1.0, 2.0, 3.0, 5.0)
FEW = 30  # observations a photo
DISTURBED = 0.005  # where the adjustment starts


def disturbed(poses: Array, amount: float, distance: float, seed: int) -> Array:
    """Poses [n, 4, 4] with independent errors."""
    rng = np.random.default_rng(seed)
    moved = poses.copy()
    turn = so3_exp(torch.from_numpy(rng.normal(0, amount, (len(poses), 3)))).numpy()
    moved[:, :3, :3] = turn @ poses[:, :3, :3]
    moved[:, :3, 3] += rng.normal(0, amount * distance, (len(poses), 3))
    return moved


def measured(truth: Dataset, seed: int) -> Iterator[dict[str, object]]:
    with tempfile.TemporaryDirectory() as folder:
        seeding = seed_poses(without_poses(truth), seed=seed, remember=Path(folder) / "seeding.json")
        tracks = Tracks.load(Path(folder) / KEPT, truth.names)
    matched = next((c for c in seeding.candidates if c.matched.any()), None)
    if matched is None:
        raise SystemExit("no feature matches of perspective cameras")
    poses = truth.world_from_cam
    distance, known = focus_point(poses).mean_distance, np.ones(len(truth), np.bool_)
    start = disturbed(poses, DISTURBED, distance, seed)
    loose = PosePrior.equal(start, PRIOR, PRIOR * distance)

    def error(found: Array) -> float:
        return float(
            camera_errors(align_by_spread(found, poses).apply_to_poses(found), poses).rotation_deg.mean()
        )

    inputs = {f"{np.degrees(e):.2f} deg": disturbed(poses, e, distance, seed + 1) for e in ERRORS}
    inputs["COLMAP"] = matched.world_from_cam
    for amount, most in (("all", EvidenceNumbers().most_observations), ("few", FEW * len(truth))):
        evidence = fitted_tracks(truth, tracks, most)
        alone = adjust_poses(start, evidence, loose).world_from_cam
        for name, given in inputs.items():
            found = room.given_poses(given, alone, matched.matched if name == "COLMAP" else known)
            if found is None:
                continue
            line = {"tracks": amount, "input": name, "input_deg": error(given), "without": error(alone)}
            for factor in FACTORS:
                with patch.object(room, "SHARED_ERRORS", factor):
                    line[f"x {factor:g}"] = error(
                        adjust_poses(start, evidence, found.prior(loose)).world_from_cam
                    )
            yield {key: round(v, 3) if isinstance(v, float) else v for key, v in line.items()}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("sets", nargs="+", type=Path)
    parser.add_argument("--seed", type=int, default=1)
    asked = parser.parse_args()
    for path in asked.sets:
        truth = read_dataset(path)
        posed = tuple(frame for frame in truth.frames if frame.world_from_cam is not None)
        for line in measured(replace(truth, frames=posed), asked.seed):
            print(json.dumps({"set": path.name, **line}), flush=True)


if __name__ == "__main__":
    main()
