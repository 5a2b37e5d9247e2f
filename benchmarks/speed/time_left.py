"""How accurate the predicted time left is: ``python -m benchmarks.speed.time_left SET... [--preset fast]``.

Each SET holds true poses, which get BARF's noise (0.15). Prints how long each run took, and at 10, 25, 50,
75 and 90 % of that time the predicted seconds to the end over the actual ones. Before the first step nothing is
predicted (``-``).
"""

from __future__ import annotations

import argparse
import tempfile
import time
from bisect import bisect_right
from pathlib import Path

from biresnerf.data.formats.read_dataset import read_dataset
from biresnerf.geometry.perturb import perturb_poses
from biresnerf.options.refine_options import parse_options
from biresnerf.pipeline import refine_poses
from biresnerf.progress import Progress
from biresnerf.studies.scenes import with_poses

SHARES = (0.1, 0.25, 0.5, 0.75, 0.9)


def told_and_taken(path: Path, preset: str, noise: float) -> tuple[float, list[float | None]]:
    """The seconds of a run, and the ratios of the time told and the time that was left."""
    truth = read_dataset(path)
    given = with_poses(truth, perturb_poses(truth.world_from_cam, noise, seed=1))
    told: list[tuple[float, float | None]] = []

    def listen(progress: Progress) -> None:
        told.append((time.monotonic(), progress.eta_s))

    began = time.monotonic()
    with tempfile.TemporaryDirectory() as folder:
        refine_poses(given, Path(folder), parse_options({"preset": preset}), listen)
    seconds = time.monotonic() - began
    ratios: list[float | None] = []
    for share in SHARES:
        now = began + share * seconds
        at, eta_s = told[max(0, bisect_right([when for when, _ in told], now) - 1)]
        left_s = None if eta_s is None else eta_s - (now - at)
        ratios.append(None if left_s is None else left_s / ((1 - share) * seconds))
    return seconds, ratios


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("sets", nargs="+", type=Path)
    parser.add_argument("--preset", default="fast")
    parser.add_argument("--noise", type=float, default=0.15)
    options = parser.parse_args()
    print("| set | seconds |" + "".join(f" at {share:.0%} |" for share in SHARES))
    print("|---|---|" + "---|" * len(SHARES))
    for path in options.sets:
        seconds, ratios = told_and_taken(path, options.preset, options.noise)
        cells = "".join(" - |" if ratio is None else f" {ratio:.2f} |" for ratio in ratios)
        print(f"| {path.name} | {seconds:.0f} |{cells}", flush=True)


if __name__ == "__main__":
    main()
