"""Which poses a run starts from, and why: ``python -m benchmarks.runs.start SET... [--noise 0.15] [--seed 1]``.

Each SET holds true poses, which get BARF's noise. COLMAP is asked, and trials of preset ``fast`` decide. Prints a JSON
line for each candidate: how many cameras matches placed, the mean rotation error (deg), the share of left-out matches
that it explains, and its mean PSNR on unseen views when the trials ended; with the seconds that they took.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

from biresnerf.compile_kernels import compile_kernels
from biresnerf.data.formats.read_dataset import read_dataset
from biresnerf.data.photos.images import load_images
from biresnerf.data.points.tracks import KEPT, Tracks
from biresnerf.data.seeding.seed_poses import seed_poses
from biresnerf.field.backends import resolve_here, use_threads
from biresnerf.geometry.perturb import perturb_poses
from biresnerf.geometry.pose_error import pose_error
from biresnerf.options.refine_options import parse_options
from biresnerf.progress import Monitor
from biresnerf.refinement.start.choose_start import find_start
from biresnerf.refinement.start.matches_explained import matches_explained
from biresnerf.studies.scenes import with_poses


def candidates(path: Path, noise: float, seed: int) -> Iterator[dict[str, object]]:
    """All that a run could start from."""
    truth = read_dataset(path)
    given = with_poses(truth, perturb_poses(truth.world_from_cam, noise, seed=seed))
    options, device = resolve_here(parse_options({"preset": "fast", "seed": seed}))
    threads = use_threads(options.threads)
    with tempfile.TemporaryDirectory(prefix="biresnerf-benchmark-") as folder:
        seeding = seed_poses(given, seed=seed, remember=Path(folder) / "seeding.json")
        tracks = Tracks.load(Path(folder) / KEPT, given.names)
    dataset, tried = seeding.dataset, seeding.candidates
    images = load_images(dataset, options.max_image_size, options.background)
    began = time.monotonic()
    found = find_start(tried, dataset, images, tracks, options, device, threads, Monitor())
    seconds = round(time.monotonic() - began, 1)
    for i, candidate in enumerate(tried):
        poses = candidate.world_from_cam
        yield {
            "set": path.name,
            "seed": seed,
            "candidate": candidate.source,
            "taken": candidate.source == found.source,
            "placed": int(candidate.matched.sum()),
            "of": len(truth),
            "rotation_deg": round(
                pose_error(poses, truth.world_from_cam).aligned_robust.rotation_deg.mean, 2
            ),
            "explained": None if tracks is None else round(matches_explained(dataset, tracks, poses), 3),
            "psnr": round(found.trials[i].psnr, 2) if found.trials else None,
            "seconds": seconds,
        }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("sets", nargs="+", type=Path)
    parser.add_argument("--noise", type=float, default=0.15)
    parser.add_argument("--seed", type=int, default=1)
    asked = parser.parse_args()
    compile_kernels(field=True)
    for path in asked.sets:
        for line in candidates(path, asked.noise, asked.seed):
            print(json.dumps(line), flush=True)


if __name__ == "__main__":
    main()
