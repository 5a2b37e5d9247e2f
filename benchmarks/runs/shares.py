"""Where the time of a whole run goes: ``python -m benchmarks.runs.shares SET... [--preset fast] [--seed 1]``.

Each SET holds true poses, which get BARF's noise (0.15). Prints a row for each as soon as it is done: wall seconds of
the parts, the share of all but steps, adjusting and checking (``rest``), and the mean rotation error. With ``--clock
cpu`` seconds are those of all processors together, COLMAP's included. With ``--json FILE`` a line for each run, by
both clocks, goes to that file. A set that fails has its error as row, and the others go on.
"""

from __future__ import annotations

import argparse
import json
import os
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.speed.clock import timed
from biresnerf import pipeline
from biresnerf.commands.settings_option import parse_settings
from biresnerf.compile_kernels import compile_kernels
from biresnerf.data.formats.read_dataset import read_poses
from biresnerf.geometry.perturb import perturb_poses
from biresnerf.geometry.pose_error import pose_error
from biresnerf.options.refine_options import parse_options
from biresnerf.refinement.finish import adjust_cameras, rounds
from biresnerf.refinement.stages.two_stages import TwoStages
from biresnerf.studies.scenes import find_scene, read_scene, with_poses

CHECKING = "checking"
OUTER = [
    (pipeline, "seed_poses", "COLMAP"),
    (pipeline, "find_start", "start"),
    (TwoStages, "run_stage_1", "stage 1"),
    (TwoStages, "run_stage_2", "stage 2"),
    (rounds, "adjust_cameras", "adjusting"),
    (pipeline, "fit_held_out_poses", "evaluating"),
    (pipeline, "evaluate", "evaluating"),
    (pipeline, "judge_poses", "verdict"),
    (pipeline, "write_result", "writing"),
]
INNER = [(adjust_cameras, "photos_object", CHECKING)]
WORK = ("stage 1", "stage 2", "adjusting", CHECKING)
OTHER = "other"  # reading the set and its photos, above all
COLUMNS = ("COLMAP", "start", OTHER, *WORK, "evaluating", "verdict", "writing")


def processor_s() -> float:
    """Processor seconds of this process and of its children that ended."""
    spent = os.times()
    return spent.user + spent.system + spent.children_user + spent.children_system


CLOCKS = {"wall": time.perf_counter, "cpu": processor_s}


def run(path: Path, preset: str, seed: int, noise: float, changed: dict[str, Any]) -> dict[str, Any]:
    """One run: seconds of each part and of all by either clock, and the mean error of the rotations (deg)."""
    truth = read_scene(find_scene(path, 1, test_views=0))
    given = with_poses(truth, perturb_poses(truth.world_from_cam, noise, seed=seed))
    options = parse_options({"preset": preset, "seed": seed, **changed})
    began = {name: clock() for name, clock in CLOCKS.items()}
    with (
        tempfile.TemporaryDirectory() as folder,
        timed([*OUTER, *INNER], CLOCKS["wall"]) as wall,
        timed([*OUTER, *INNER], CLOCKS["cpu"]) as cpu,
    ):
        report = pipeline.refine_poses(given, Path(folder, "run"), options)
        total = {name: clock() - began[name] for name, clock in CLOCKS.items()}
        refined = np.stack(list(read_poses(Path(folder, "run", "transforms.json")).values()))
    found: dict[str, Any] = {
        "set": path.name, "preset": preset, "seed": seed, "photos": len(truth), "steps": report.steps_done,
        "verdict": report.verdict.verdict if report.verdict else None,
        "rotation_deg": pose_error(refined, truth.world_from_cam).aligned_robust.rotation_deg.mean,
    }  # fmt: skip
    for name, spent in (("wall", wall), ("cpu", cpu)):
        spent["adjusting"] -= spent[CHECKING]
        spent[OTHER] = total[name] - sum(spent.values())
        rest = 1 - sum(spent[part] for part in WORK) / total[name]
        found[name] = {**{part: round(s, 2) for part, s in spent.items()}, "all": round(total[name], 2)}
        found[f"{name}_rest"] = round(rest, 3)
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("sets", nargs="+", type=Path)
    parser.add_argument("--preset", default="fast")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--noise", type=float, default=0.15)
    parser.add_argument("--clock", choices=tuple(CLOCKS), default="wall")
    parser.add_argument(
        "--set", action="append", default=[], metavar="KEY=VALUE", help="an option of the runs"
    )
    parser.add_argument("--json", type=Path, metavar="FILE")
    asked = parser.parse_args()
    changed = parse_settings(tuple(asked.set))
    compile_kernels(field=True)
    print("| set | all | rest | " + " | ".join(COLUMNS) + " | rotation |")
    print("|---|---|---|" + "---|" * len(COLUMNS) + "---|", flush=True)
    for path in asked.sets:
        try:
            found = run(path, asked.preset, asked.seed, asked.noise, changed)
        except Exception as error:  # noqa: BLE001 - the other sets are measured all the same
            print(f"| {path.name} | {type(error).__name__}: {error} |", flush=True)
            continue
        spent = found[asked.clock]
        cells = " | ".join(f"{spent[part]:.1f}" for part in COLUMNS)
        rest, turned = found[f"{asked.clock}_rest"], found["rotation_deg"]
        print(f"| {path.name} | {spent['all']:.0f} s | {rest:.0%} | {cells} | {turned:.3f}° |", flush=True)
        if asked.json is not None:
            with asked.json.open("a", encoding="utf-8") as file:
                file.write(json.dumps(found) + "\n")


if __name__ == "__main__":
    main()
