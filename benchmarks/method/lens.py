"""How well adjusting all cameras to a set's feature matches finds a wrong or unknown lens.

    python -m benchmarks.method.lens SET --focal 1.05
    python -m benchmarks.method.lens SET --hidden --focal 1.01

The set's poses are the truth. They are turned and moved at random; all cameras are adjusted to tracks with the wrong
focal length, and from there with the focal length unknown. Prints mean rotation errors after alignment, and the focal
length's error and standard deviation.

With --hidden the lens is replaced by one of a single focal length, without distortion and with its principal point in
the middle. Prints errors with the lens given, with more and more parameters free, and with those the evidence supports.
"""

from __future__ import annotations

import argparse
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from benchmarks.method.track_evidence import fitted_tracks
from biresnerf.data.formats.read_dataset import read_dataset
from biresnerf.data.model.dataset import Dataset
from biresnerf.data.points.tracks import KEPT, Tracks
from biresnerf.data.seeding.map_images import ask_colmap
from biresnerf.geometry.camera.camera import Intrinsics
from biresnerf.geometry.camera.camera_models import Camera
from biresnerf.geometry.focus import focus_point
from biresnerf.geometry.lie import so3_exp
from biresnerf.geometry.pose_error import camera_errors
from biresnerf.geometry.similarity import align_by_spread
from biresnerf.refinement.adjustment.adjustment import Adjustment, adjust_poses
from biresnerf.refinement.adjustment.evidence import Evidence, PosePrior
from biresnerf.refinement.adjustment.ideal import straight_tracks
from biresnerf.refinement.adjustment.lens.corrected_camera import corrected_camera
from biresnerf.refinement.adjustment.lens.lenses import CENTRE, K1, K2, LENS
from biresnerf.refinement.finish.lens_evidence import lenses_before
from biresnerf.refinement.finish.lens_model import supported_lenses
from biresnerf.refinement.numbers.finish import EvidenceNumbers

PRIOR = EvidenceNumbers().prior

Array = NDArray[np.float64]

DISTURBED = 0.01  # rad, and shares of the cameras' distance


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("set", type=Path)
    parser.add_argument("--focal", type=float, default=1.05, help="so many times the set's")
    parser.add_argument("--hidden", action="store_true", help="replace the lens")
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
    truth, distance = given.world_from_cam, focus_point(given.world_from_cam).mean_distance
    start = _disturbed(truth, distance, asked.seed)
    if asked.hidden:
        compare_models(given, tracks, start, asked.focal)
        return
    wrong = tuple(corrected_camera(c, np.array([np.log(asked.focal), *(0.0,) * 7])) for c in given.cameras)
    given = replace(given, cameras=wrong)
    evidence = fitted_tracks(given, tracks)
    held = adjust_poses(start, evidence, PosePrior.equal(start, PRIOR, PRIOR * distance))
    freed = adjust_poses(
        held.world_from_cam,
        replace(evidence, lenses=lenses_before(given, "focal", EvidenceNumbers())),
        PosePrior.equal(held.world_from_cam, PRIOR, PRIOR * distance),
    )
    for name, found in (("held", held), ("refined", freed)):
        _print(f"focal length {name}", found, truth)
    assert freed.lenses is not None
    for row in range(len(given.cameras)):
        off = 100 * (np.exp(freed.lenses.correction[row, 0]) * asked.focal - 1)
        deviation, told = 100 * freed.lenses.deviation[row, 0], bool(freed.lenses.observable[row, 0])
        print(f"camera {row}: off by {off:.3f} %, standard deviation {deviation:.3f} %, observable {told}")


def compare_models(given: Dataset, tracks: Tracks, start: Array, focal: float) -> None:
    """Print errors with the lens given and hidden."""
    truth, distance = given.world_from_cam, focus_point(given.world_from_cam).mean_distance
    prior = PosePrior.equal(start, PRIOR, PRIOR * distance)
    _print("lens given", adjust_poses(start, fitted_tracks(given, tracks), prior), truth)
    hidden = tuple(
        Camera("SIMPLE_RADIAL", c.width, c.height, (focal * c.full().fx, c.width / 2, c.height / 2, 0.0))
        for c in given.cameras
    )
    hid = replace(given, cameras=hidden, intrinsics_sources=("colmap",) * len(hidden))
    evidence, before = fitted_tracks(hid, tracks), lenses_before(hid, "auto", EvidenceNumbers())
    judging = straight_tracks(
        tracks, Intrinsics.from_cameras([hid.camera_of(i) for i in range(len(hid))]), evidence.intrinsics
    )
    left_out = Evidence(evidence.intrinsics, judging.split()[1])
    supported = supported_lenses(
        start, replace(evidence, lenses=before), left_out, prior, hidden, lambda: None
    )
    assert supported is not None
    models = {
        "f, k1": before.held(np.arange(LENS) > K1),
        "f, k1, k2": before.held(np.arange(LENS) > K2),
        "all free": before,
        "supported": supported,
    }
    for name, lenses in models.items():
        found = adjust_poses(start, replace(evidence, lenses=lenses), prior)
        assert found.lenses is not None
        _print(name, found, truth)
        for row, camera in enumerate(hidden):
            centre = np.hypot(*found.lenses.deviation[row, CENTRE])
            print(f"  camera {row}: {corrected_camera(camera, found.lenses.correction[row])}")
            print(f"  standard deviation of its principal point: {np.degrees(centre):.3f} degrees")
        print(f"  true: {given.cameras}")


def _print(name: str, found: Adjustment, truth: Array) -> None:
    aligned = align_by_spread(found.world_from_cam, truth).apply_to_poses(found.world_from_cam)
    turned = camera_errors(aligned, truth).rotation_deg.mean()
    print(f"{name}: {turned:.3f} degrees, noise {found.track_noise_px:.3f} px")


def _disturbed(truth: Array, distance: float, seed: int) -> Array:
    rng, start = np.random.default_rng(seed), truth.copy()
    turns = so3_exp(torch.from_numpy(rng.normal(0, DISTURBED, (len(truth), 3)))).numpy()
    start[:, :3, :3] = turns @ truth[:, :3, :3]
    start[:, :3, 3] += rng.normal(0, DISTURBED * distance, (len(truth), 3))
    return start


if __name__ == "__main__":
    main()
