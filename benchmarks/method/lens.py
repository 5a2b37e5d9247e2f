"""A focal length that is given too long, found by the adjustment of all cameras to a set's feature matches.

    python -m benchmarks.method.lens SET --focal 1.05

The set's poses are the truth. They are turned and moved at random; all cameras are adjusted to tracks with the wrong
focal length, and from there with the focal length unknown. Printed are mean rotation errors after alignment, and the
focal length's error and standard deviation.
"""

from __future__ import annotations

import argparse
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from benchmarks.method.track_evidence import fitted_tracks
from biresnerf.data.formats.read_dataset import read_dataset
from biresnerf.data.points.tracks import KEPT, Tracks
from biresnerf.data.seeding.map_images import ask_colmap
from biresnerf.geometry.focus import focus_point
from biresnerf.geometry.lie import so3_exp
from biresnerf.geometry.pose_error import camera_errors
from biresnerf.geometry.similarity import align_by_spread
from biresnerf.refinement.adjustment.adjustment import adjust_poses
from biresnerf.refinement.adjustment.evidence import PosePrior
from biresnerf.refinement.adjustment.lens.corrected_camera import corrected_camera
from biresnerf.refinement.finish.candidates import PRIOR
from biresnerf.refinement.finish.lens_evidence import lenses_before

DISTURBED = 0.01  # rad, and shares of the cameras' distance


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("set", type=Path)
    parser.add_argument("--focal", type=float, default=1.05, help="so many times the set's")
    parser.add_argument("--seed", type=int, default=1)
    asked = parser.parse_args()
    given = read_dataset(asked.set)
    with tempfile.TemporaryDirectory() as folder:
        ask_colmap(
            given, should_stop=lambda: False, seed=asked.seed, effort="full", limit_s=3600.0, log_folder=Path(folder)
        )  # fmt: skip
        tracks = Tracks.load(Path(folder, KEPT), given.names)
    if tracks is None:
        raise SystemExit("no feature matches")
    wrong = tuple(corrected_camera(c, np.array([np.log(asked.focal), 0.0, 0.0])) for c in given.cameras)
    given = replace(given, cameras=wrong)
    evidence = fitted_tracks(given, tracks)
    truth, distance = given.world_from_cam, focus_point(given.world_from_cam).mean_distance
    rng = np.random.default_rng(asked.seed)
    start = truth.copy()
    start[:, :3, :3] = (
        so3_exp(torch.from_numpy(rng.normal(0, DISTURBED, (len(truth), 3)))).numpy() @ truth[:, :3, :3]
    )
    start[:, :3, 3] += rng.normal(0, DISTURBED * distance, (len(truth), 3))

    held = adjust_poses(start, evidence, PosePrior.equal(start, PRIOR, PRIOR * distance))
    freed = adjust_poses(
        held.world_from_cam,
        replace(evidence, lenses=lenses_before(given, "focal")),
        PosePrior.equal(held.world_from_cam, PRIOR, PRIOR * distance),
    )
    for name, found in (("held", held), ("refined", freed)):
        aligned = align_by_spread(found.world_from_cam, truth).apply_to_poses(found.world_from_cam)
        turned = camera_errors(aligned, truth).rotation_deg.mean()
        print(f"focal length {name}: {turned:.3f} degrees, noise {found.track_noise_px:.3f} px")
    assert freed.lenses is not None
    for row in range(len(given.cameras)):
        off = 100 * (np.exp(freed.lenses.correction[row, 0]) * asked.focal - 1)
        deviation, told = 100 * freed.lenses.deviation[row, 0], bool(freed.lenses.observable[row, 0])
        print(f"camera {row}: off by {off:.3f} %, standard deviation {deviation:.3f} %, observable {told}")


if __name__ == "__main__":
    main()
