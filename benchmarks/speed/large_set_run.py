"""One run of a job, its parts told apart by the profiler: for `benchmarks.speed.large_set`."""

from __future__ import annotations

import cProfile
import pstats
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

from biresnerf.data.formats.read_dataset import read_dataset
from biresnerf.data.model.dataset import Dataset
from biresnerf.data.photos.turning_object import turning_notes
from biresnerf.data.seeding.map_images import lay_out
from biresnerf.options.refine_options import parse_options
from biresnerf.pipeline import refine_poses

Function = tuple[str, str]  # file, name
# Functions that the seconds of a part are spent in. None lies within another, where only some callers count.
PARTS: dict[str, tuple[Function, ...]] = {
    "reading the set": (("read_dataset.py", "read_dataset"),),
    "decoding to working size": (("photos/images.py", "load_images"),),
    "fingerprint": (("biresnerf/resume.py", "run_origin"),),
    "matching": (("seed_poses.py", "seed_poses"),),
    "choosing the start": (("choose_start.py", "find_start"),),
    "pairs by poses": (("large_set_run.py", "pairs_by_poses"),),
    "pairs by likeness": (("large_set_run.py", "pairs_by_likeness"),),
    "whether it turns": (("turning_object.py", "turning_notes"),),
    "setting up": (("first_step.py", "first_step"), ("two_stages.py", "__init__")),
    "repair": (("two_stages.py", "_repair"),),
    "adjusting": (("adjust_cameras.py", "adjust_cameras"),),
    "checkpoints": (("two_stages.py", "_save"),),
    "previews": (("two_stages.py", "_preview"),),
    "evaluation": (("evaluate.py", "evaluate"),),
    "verdict": (("judgement.py", "judge"),),
    "accuracy of poses": (("pose_uncertainty.py", "pose_uncertainty"),),
    "results": (("write/result.py", "write_result"), ("run_report.py", "run_report")),
}
STEP: Function = ("joint_optimiser.py", "step")
# The adjustment decodes photos as well, the verdict trains, and previews have a report.
CALLED_BY: dict[Function, Function] = {
    ("photos/images.py", "load_images"): ("pipeline.py", "_seed"),
    ("run_report.py", "run_report"): ("pipeline.py", "refine_poses"),
    STEP: ("two_stages.py", "_step"),
}
BESIDES = ("pairs by poses", "pairs by likeness", "whether it turns")  # done by jobs with other options
# What does not grow with the photos is kept short.
SHORT = {"orbit_frames": 2, "shown_views": 2, "trial_steps": 100}
SLOWEST = 40
NUMBERS = (
    "pairs to match where poses are given",
    "pairs to match where none is",
    "most memory of the job, MiB",
)


def pairs_by_likeness(dataset: Dataset) -> int:
    """How many pairs of photos would be matched without poses."""
    without = replace(dataset, frames=tuple(replace(f, world_from_cam=None) for f in dataset.frames))
    return _pairs(without)


def pairs_by_poses(dataset: Dataset) -> int:
    """How many pairs of photos would be matched with the poses given."""
    return _pairs(dataset)


def _pairs(dataset: Dataset) -> int:
    with tempfile.TemporaryDirectory() as folder:
        chosen = lay_out(dataset, Path(folder))["pairs"]
    return len(dataset) * (len(dataset) - 1) // 2 if chosen is None else len(chosen)


def measured(path: Path, settings: dict[str, Any], *, profile: bool = False) -> dict[str, float]:
    """Processor seconds by part of a run on the set of a transforms file, and the most memory held, MiB."""
    profiler = cProfile.Profile(time.process_time)
    started = time.process_time()
    profiler.enable()
    dataset = read_dataset(path)
    with tempfile.TemporaryDirectory() as folder:
        refine_poses(dataset, Path(folder), parse_options({**SHORT, **settings}))
    job_s, memory_mib = time.process_time() - started, _most_memory_mib()
    by_poses, by_likeness = pairs_by_poses(dataset), pairs_by_likeness(dataset)
    turning_notes(replace(dataset, frames=tuple(replace(f, world_from_cam=None) for f in dataset.frames)))
    profiler.disable()
    stats = pstats.Stats(profiler, stream=sys.stderr)
    if profile:
        stats.sort_stats("tottime").print_stats(SLOWEST)
        stats.sort_stats("cumulative").print_stats(2 * SLOWEST)
    seconds = {part: sum(seconds_in(stats, f) for f in functions) for part, functions in PARTS.items()}
    steps = seconds_in(stats, STEP)
    rest = job_s - steps - sum(s for part, s in seconds.items() if part not in BESIDES)
    in_all = {"steps": steps, "everything else": rest, "the whole job": job_s}
    return {**seconds, **in_all, **dict(zip(NUMBERS, (by_poses, by_likeness, memory_mib), strict=True))}


def seconds_in(stats: pstats.Stats, function: Function) -> float:
    """In a function with all that it calls; only when called by the one of `CALLED_BY`, where that names any."""
    found: dict[tuple[str, int, str], Any] = stats.stats  # type: ignore[attr-defined]
    caller = CALLED_BY.get(function)
    return sum(
        row[3] if caller is None else sum(r[3] for who, r in row[4].items() if _is(who, caller))
        for who_is_called, row in found.items()
        if _is(who_is_called, function)
    )


def _is(profiled: tuple[str, int, str], function: Function) -> bool:
    file, name = function
    return profiled[2] == name and profiled[0].endswith(file)


def _most_memory_mib() -> float:
    lines = Path("/proc/self/status").read_text("utf-8").splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith("VmHWM")) / 1024
