"""What a step of a real set takes, part by part: ``python -m benchmarks.speed.set_step SET... [--preset fast]``.

Each SET holds true poses. They are refined from there, stage 1 for as long as the preset has it at most, then stage 2
past its warm-up. What is measured then are whole steps of stage 2, updates of the occupancy grid included: their parts,
what lies between the field's kernels (``glue``), and how many operations torch takes in a step. Processor time of one
thread.
"""

from __future__ import annotations

import argparse
import time
from collections import Counter
from pathlib import Path
from typing import Any

import torch
from torch.utils._python_dispatch import TorchDispatchMode

from benchmarks.speed.clock import timed
from benchmarks.speed.training_step import BETWEEN_KERNELS, OPERATIONS
from biresnerf.compile_kernels import compile_kernels
from biresnerf.data.photos.images import load_images
from biresnerf.field.backends import use_threads
from biresnerf.options.refine_options import RefineOptions
from biresnerf.refinement.optimise.joint_optimiser import OCCUPANCY_PERIOD, JointOptimiser
from biresnerf.refinement.scene.scene_frame import scene_frame
from biresnerf.studies.scenes import find_scene, read_scene

CPU = torch.device("cpu")
PARTS = [(JointOptimiser, "_update_occupancy", "occupancy update"), *OPERATIONS]


class Operations(TorchDispatchMode):
    """Counts torch's operations by name, views included: each costs the host some microseconds."""

    def __init__(self) -> None:
        super().__init__()
        self.count: Counter[str] = Counter()

    def __torch_dispatch__(self, function, types, args=(), kwargs=None):
        self.count[function.overloadpacket.__name__] += 1
        return function(*args, **(kwargs or {}))


def in_stage_2(path: Path, preset: str, after: int) -> JointOptimiser:
    """An optimiser `after` steps of stage 2."""
    dataset = read_scene(find_scene(path, 1, test_views=0))
    options = RefineOptions(preset=preset, device="cpu").resolved("cpu")
    images = load_images(dataset, options.max_image_size, options.background)
    frame = scene_frame(dataset.world_from_cam, images)
    start = frame.unit_from_world.apply_to_poses(dataset.world_from_cam)
    made = JointOptimiser(images, frame, start, options, [], CPU, 1)
    while made.step_index < options.coarse_steps_max:
        made.step()
    made.start_reconstruction()
    for _ in range(after):
        made.step()
    return made


def measured(joint: JointOptimiser, steps: int) -> dict[str, Any]:
    """Milliseconds of a mean step and of its parts, operations of a step, rays and samples."""
    rays = samples = 0
    with timed(PARTS, time.process_time, outermost=True) as spent:
        started = time.process_time()
        for _ in range(steps):
            result = joint.step()
            rays, samples = rays + result.rays, samples + result.samples
        seconds = time.process_time() - started
    parts = {label: 1e3 * value / steps for label, value in spent.items()}
    step_ms = 1e3 * seconds / steps
    kernels = sum(value for label, value in parts.items() if label not in BETWEEN_KERNELS)
    while joint.step_index % OCCUPANCY_PERIOD == 0:
        joint.step()
    with Operations() as operations:
        joint.step()
    return {
        "step": step_ms, "parts": parts, "glue": step_ms - kernels, "operations": operations.count,
        "rays": rays / steps, "samples": samples / steps,
    }  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("sets", type=Path, nargs="+")
    parser.add_argument("--preset", default="fast")
    parser.add_argument("--after", type=int, default=300, help="steps of stage 2 before those measured")
    parser.add_argument("--steps", type=int, default=160, help="that are measured")
    asked = parser.parse_args()
    use_threads(1)
    compile_kernels()
    for path in asked.sets:
        joint = in_stage_2(path, asked.preset, asked.after)
        found = measured(joint, asked.steps)
        print(f"\n{path.name}: {found['step']:.2f} ms a step, {found['rays']:.0f} rays, {found['samples']:.0f} "
              f"intervals, {joint.occupancy.share:.1%} of the cells occupied")  # fmt: skip
        for label, value in found["parts"].items():
            print(f"    {label:50}{value:8.2f} ms{100 * value / found['step']:6.1f} %")
        print(f"    {'glue':50}{found['glue']:8.2f} ms{100 * found['glue'] / found['step']:6.1f} %")
        most = ", ".join(f"{n} {k}" for k, n in found["operations"].most_common(8))
        print(f"    {found['operations'].total()} operations of torch: {most}", flush=True)


if __name__ == "__main__":
    main()
