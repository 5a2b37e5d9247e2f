"""What jobs on one machine take from each other: ``python -m benchmarks.service.side_by_side [--jobs 2] [--rounds 3]``.

Refinements of the same scene run at the same time, each with all cores, and one alone; the kernels' threads either
sleep while they wait, as here, or spin first, as libgomp has them do by itself.
"""

from __future__ import annotations

import argparse
import os
import resource
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from biresnerf.data.synthetic.scene import write_synthetic_scene

POLICIES = {"sleep": {}, "spin": {"GOMP_SPINCOUNT": "300000"}}
SETTINGS = (
    *("preset=fast", "start=given", "device=cpu", "verdict=false", "orbit_frames=0", "max_image_size=64"),
    *("coarse_steps_min=150", "coarse_steps_max=150"),
)


def _seconds(scene: Path, folder: Path, jobs: int, policy: str, steps: int) -> tuple[float, float]:
    """Wall seconds until the last of ``jobs`` refinements is done, and the processor seconds of all."""
    before, start = resource.getrusage(resource.RUSAGE_CHILDREN), time.monotonic()
    settings = [part for text in (*SETTINGS, f"steps={steps}") for part in ("--set", text)]
    running = [
        subprocess.Popen(
            [
                sys.executable,
                "-m",
                "biresnerf.command_line",
                "refine",
                scene,
                "--output",
                folder / f"{job}",
                *settings,
            ],
            env={**os.environ, **POLICIES[policy]},
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        for job in range(jobs)
    ]
    for process in running:
        if process.wait() != 0:
            raise SystemExit(f"a refinement failed with status {process.returncode}")
    wall, after = time.monotonic() - start, resource.getrusage(resource.RUSAGE_CHILDREN)
    return wall, after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def main() -> None:
    """Prints medians over the rounds; the policies take turns."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--steps", type=int, default=400)
    asked = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        scene, measured = Path(name) / "scene", {}
        write_synthetic_scene(scene, 20, 64, seed=1)
        for turn in range(asked.rounds):
            for jobs in (1, asked.jobs):
                for policy in POLICIES:
                    folder = Path(name) / f"{turn}-{jobs}-{policy}"
                    found = _seconds(scene, folder, jobs, policy, asked.steps)
                    measured.setdefault((jobs, policy), []).append(found)
    for (jobs, policy), found in measured.items():
        wall, busy = (statistics.median(values) for values in zip(*found, strict=True))
        print(f"{jobs} at once, waiting threads {policy}: {wall:.1f} s, {busy:.1f} s of processor")


if __name__ == "__main__":
    main()
