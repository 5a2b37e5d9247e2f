"""When a trial could have ended: ``python -m benchmarks.speed.early_looks SET... [--noise 0.15,0.02] [--seed 1]``.

Fields are trained on noisy poses and on the true ones, as for the verdict of preset ``fast``. Prints a JSON line for
each share of the training: the intervals (95 %) of the gains in PSNR and SSIM, and the processor seconds so far.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Iterator
from pathlib import Path

from biresnerf.compile_kernels import compile_kernels
from biresnerf.data.formats.read_dataset import read_dataset
from biresnerf.data.photos.images import load_images
from biresnerf.field.backends import resolve_here, use_threads
from biresnerf.geometry.perturb import perturb_poses
from biresnerf.geometry.similarity import align_by_spread
from biresnerf.options.refine_options import parse_options
from biresnerf.refinement.adjustment.paired import paired
from biresnerf.refinement.views.compare_rigs import PSNR_MATTERS, SSIM_MATTERS
from biresnerf.refinement.views.held_out_views import held_out_views, unseen_rounds
from biresnerf.refinement.views.pose_trials import PoseTrials
from biresnerf.report import PairedDifference

SHARES = (0.125, 0.25, 0.5, 1.0)


def looks(path: Path, noise: float, seed: int, threads: int) -> Iterator[dict[str, object]]:
    """What fields at noisy and at true poses predict after each share of the training."""
    options, device = resolve_here(parse_options({"preset": "fast", "seed": seed, "threads": threads}))
    truth = read_dataset(path)
    images, true = load_images(truth, options.max_image_size, options.background), truth.world_from_cam
    noisy = perturb_poses(true, noise, seed=seed)
    noisy = align_by_spread(noisy, true).apply_to_poses(noisy)
    unseen = unseen_rounds(len(images), held_out_views(len(images), "auto"))[0]
    steps = options.trial_steps
    trials = PoseTrials(images, unseen, [noisy, true], options, steps, device, threads, lambda: False)
    running = [trials.begin(noisy), trials.begin(true)]
    began = time.process_time()
    for share in SHARES:
        for trial in running:
            trial.train(share)
        before, after = (trial.scores() for trial in running)
        yield {
            "share": share,
            "seconds": round(time.process_time() - began, 1),
            "psnr": interval(paired(before.psnr, after.psnr, PSNR_MATTERS)),
            "ssim": interval(paired(before.ssim, after.ssim, SSIM_MATTERS)),
        }


def interval(found: PairedDifference) -> list[float | None]:
    return [None if end is None else round(end, 3) for end in (found.low, found.high)]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("sets", nargs="+", type=Path)
    parser.add_argument("--noise", default="0.15,0.02")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--threads", type=int, default=1)
    asked = parser.parse_args()
    use_threads(asked.threads)
    compile_kernels(field=True)
    for path in asked.sets:
        for noise in map(float, asked.noise.split(",")):
            for line in looks(path, noise, asked.seed, asked.threads):
                print(json.dumps({"set": path.name, "noise": noise, **line}), flush=True)


if __name__ == "__main__":
    main()
