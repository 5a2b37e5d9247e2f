"""`biresnerf bench`: the time per optimisation step on this machine."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

import click

from biresnerf.commands.answers import json_option, print_json, table
from biresnerf.options.presets import PRESETS
from biresnerf.options.refine_options import RefineOptions


@click.command("bench")
@click.option(
    "--preset", type=click.Choice(list(PRESETS)), default="fast", show_default=True, help="The preset to measure."
)  # fmt: skip
@click.option(
    "--device", type=click.Choice(["auto", "cpu", "cuda"]), default="auto", show_default=True,
    help="auto: the GPU if there is one.",
)  # fmt: skip
@click.option("--threads", type=click.IntRange(0, 256), default=0, help="0: all cores.")
@click.option(
    "--steps", type=click.IntRange(4, 10_000), default=60, show_default=True, help="Steps per stage."
)
@click.option(
    "--views", type=click.IntRange(6, 400), default=30, show_default=True, help="Images of the scene."
)
@click.option(
    "--size", type=click.IntRange(16, 800), default=100, show_default=True, help="Width of its images, px."
)
@json_option
def bench_command(as_json: bool, steps: int, views: int, size: int, **given: Any) -> None:
    """Measure the time per step of both stages on this machine.

    Runs the first steps on a small synthetic scene and prints medians without the first quarter. Later steps of a run
    take other numbers of samples. `make bench` measures single kernels (docs/speed.md).
    """
    options = RefineOptions(**given, max_image_size=size)
    with tempfile.TemporaryDirectory(prefix="biresnerf-bench-") as folder:
        found = measured(options, Path(folder), steps, views, size)
    if as_json:
        print_json(found)
        return
    click.echo(f"{found['machine']}; {found['device']}, {found['threads']} threads; preset {options.preset}")
    click.echo(f"kernels ready after {found['kernels_s']:.1f} s")
    rows = [("stage", "ms a step", "90 %", "rays", "samples", "million samples/s")]
    for stage in found["stages"]:
        times = (f"{stage['step_ms']:.1f}", f"{stage['step_ms_90']:.1f}")
        samples = (str(stage["samples"]), f"{stage['samples_per_s'] / 1e6:.2f}")
        rows.append((stage["stage"], *times, str(stage["rays"]), *samples))
    click.echo(table(rows))


def measured(options: RefineOptions, folder: Path, steps: int, views: int, size: int) -> dict[str, Any]:
    """The measurements, as `--json` prints them."""
    import time

    from biresnerf.commands.machine.this_machine import describe_machine
    from biresnerf.compile_kernels import compile_kernels
    from biresnerf.data.formats.read_dataset import read_dataset
    from biresnerf.data.photos.images import load_images
    from biresnerf.data.synthetic.scene import write_synthetic_scene
    from biresnerf.field.backends import resolve_here, use_threads
    from biresnerf.geometry.perturb import perturb_poses
    from biresnerf.refinement.optimise.joint_optimiser import JointOptimiser
    from biresnerf.refinement.optimise.methods import Recipe
    from biresnerf.refinement.scene.scene_frame import scene_frame

    resolved, device = resolve_here(options)
    threads = use_threads(options.threads)
    began = time.monotonic()
    compile_kernels(field=device.type == "cpu")
    kernels_s = time.monotonic() - began
    dataset = read_dataset(write_synthetic_scene(folder, views, size, 1))
    images = load_images(dataset, size, resolved.background)
    poses = perturb_poses(dataset.world_from_cam, 0.05, 1)
    recipe = Recipe.of(resolved, device, threads)
    frame = scene_frame(poses, images, recipe.method.scene)
    start = frame.unit_from_world.apply_to_poses(poses)
    optimiser = JointOptimiser(images, frame, start, recipe, [])
    stages = []
    for name in ("coarse", "fine"):
        if name == "fine":
            optimiser.start_reconstruction()
        stages.append({"stage": name, **_timed(optimiser, steps)})
    return {
        "machine": describe_machine(),
        "device": str(device),
        "threads": threads,
        "preset": resolved.preset,
        "kernels_s": kernels_s,
        "steps": steps,
        "stages": stages,
    }


def _timed(optimiser: Any, steps: int) -> dict[str, Any]:
    import time

    import numpy as np
    import torch

    seconds, samples = [], []
    for _ in range(steps):
        began = time.perf_counter()
        result = optimiser.step()
        if optimiser.device.type == "cuda":
            torch.cuda.synchronize()
        seconds.append(time.perf_counter() - began)
        samples.append(int(result.samples))
    warm = steps // 4
    median, late = np.percentile(seconds[warm:], (50, 90))
    count = float(np.median(samples[warm:]))
    return {
        "step_ms": 1e3 * float(median),
        "step_ms_90": 1e3 * float(late),
        "rays": int(optimiser.rays),
        "samples": round(count),
        "samples_per_s": count / float(median),
    }
