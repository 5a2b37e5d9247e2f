"""Tests whether stated errors are right: ``python -m benchmarks.method.uncertainty SET... --run RUN TRUTH ...``.

Each SET holds true poses: cameras are adjusted from the truth to the tracks of its feature matches, and expected errors
compared with actual ones. The report of a finished RUN is compared with the poses of TRUTH. Prints, for each and in
total, how many rotation and centre errors after alignment are within the 90 % bounds.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks.method.track_evidence import fitted_tracks
from biresnerf.commands.poses.evaluate import matched_names
from biresnerf.data.formats.read_dataset import read_dataset, read_poses
from biresnerf.data.formats.simple.poses_json import POSES, matrix_of, read_poses_json
from biresnerf.data.points.tracks import Tracks
from biresnerf.data.seeding.seed_poses import seed_poses
from biresnerf.geometry.focus import focus_point
from biresnerf.geometry.pose_error import camera_errors
from biresnerf.geometry.similarity import align_by_spread
from biresnerf.refinement.adjustment.adjustment import adjust_poses
from biresnerf.refinement.adjustment.evidence import PosePrior
from biresnerf.refinement.finish.expected_errors import expected_errors
from biresnerf.refinement.numbers.finish import EvidenceNumbers

PRIOR = EvidenceNumbers().prior

Array = NDArray[np.float64]


def of_set(folder: Path) -> tuple[Array, Array]:
    """Errors over bounds [known, 2] (rotation, centre) of cameras adjusted to tracks; and the errors (deg, %)."""
    truth = read_dataset(folder)
    with tempfile.TemporaryDirectory() as work:
        seed_poses(truth, seed=1, remember=Path(work) / "seeding.json")
        tracks = Tracks.load(Path(work) / "tracks.npz", truth.names)
    evidence = fitted_tracks(truth, tracks)
    distance = focus_point(truth.world_from_cam).mean_distance
    prior = PosePrior.equal(truth.world_from_cam, PRIOR, PRIOR * distance)
    poses = adjust_poses(truth.world_from_cam, evidence, prior).world_from_cam
    found = expected_errors(poses, poses, evidence)
    turned, shifted = found.bounds_90()
    return _compared(poses, truth.world_from_cam, np.degrees(turned), shifted)


def of_run(folder: Path, truth: Path) -> tuple[Array, Array]:
    """The same for a finished run."""
    document, true = read_poses_json(folder / POSES), read_poses(truth)
    images = {image.name: image for image in document.images}
    pairs = matched_names(list(images), list(true))
    said = [images[name].uncertainty for name, _ in pairs]
    bounds = [
        [
            np.nan if each is None or value is None else value
            for each in said
            for value in (getattr(each, key),)
        ]
        for key in ("rotation_deg", "position")
    ]
    poses = np.stack([matrix_of(images[name].world_from_cam) for name, _ in pairs])
    return _compared(poses, np.stack([true[name] for _, name in pairs]), *map(np.array, bounds))


def _compared(poses: Array, truth: Array, turned_deg: Array, shifted: Array) -> tuple[Array, Array]:
    frame = align_by_spread(poses, truth)
    errors = camera_errors(frame.apply_to_poses(poses), truth)
    known = np.isfinite(turned_deg)
    ratios = np.stack([errors.rotation_deg / turned_deg, errors.centre / (frame.scale * shifted)], 1)
    percent = 100 / focus_point(truth).mean_distance
    figures = np.stack(
        [errors.rotation_deg, turned_deg, percent * errors.centre, percent * frame.scale * shifted], 1
    )
    return ratios[known], figures[known]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("sets", nargs="*", type=Path)
    parser.add_argument("--run", nargs=2, type=Path, action="append", default=[], metavar=("RUN", "TRUTH"))
    asked = parser.parse_args()
    all_ratios = []
    work = [(str(folder), of_set, (folder,)) for folder in asked.sets]
    work += [(str(run), of_run, (run, truth)) for run, truth in asked.run]
    for name, measure, arguments in work:
        ratios, figures = measure(*arguments)
        if len(ratios) == 0:
            print(json.dumps({"set": name, "cameras": 0}), flush=True)
            continue
        all_ratios.append(ratios)
        medians = dict(
            zip(
                ("rotation_deg", "rotation_90", "centre_percent", "centre_90"),
                np.median(figures, axis=0).round(4).tolist(),
                strict=True,
            )
        )
        print(
            json.dumps(
                {
                    "set": name,
                    "cameras": len(ratios),
                    "within": (ratios < 1).mean(0).round(3).tolist(),
                    **medians,
                    "ratio_90": np.quantile(ratios, 0.9, axis=0).round(2).tolist(),
                }
            ),
            flush=True,
        )
    if all_ratios:
        within = np.mean([(each < 1).mean(0) for each in all_ratios], axis=0)
        print(json.dumps({"sets": len(all_ratios), "within": within.round(3).tolist()}))


if __name__ == "__main__":
    main()
