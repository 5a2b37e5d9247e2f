"""Times a whole training step and its parts: `make bench`. The definition in plain torch may compete."""

from __future__ import annotations

import copy
from dataclasses import replace
from typing import Any
from unittest.mock import patch

import numpy as np
import torch

from benchmarks.speed import scene
from benchmarks.speed.clock import Clock, interleave, peak_memory, ratio, summary, timed
from biresnerf.field.cpu import field as cpu_field
from biresnerf.field.reference.field import ReferenceField
from biresnerf.refinement.optimise import joint_optimiser
from biresnerf.refinement.optimise.joint_optimiser import JointOptimiser
from biresnerf.refinement.optimise.photo_sampler import PhotoSampler
from biresnerf.refinement.parameters.pose_parameters import PoseParameters

OPERATIONS = [
    (PhotoSampler, "draw", "draw pixels"),
    (PoseParameters, "matrices", "pose matrices"),
    (joint_optimiser, "viewing_directions", "cast rays"),
    (joint_optimiser, "cast_rays", "cast rays"),
    (cpu_field, "harmonics", "view harmonics"),
    (cpu_field.march_kernels, "march", "march"),
    (cpu_field.march_kernels, "pack", "pack samples"),
    (cpu_field.CpuField, "_density", "estimate of densities"),
    (cpu_field, "merge", "merge intervals"),
    (cpu_field.CpuField, "_encode", "encode"),
    (cpu_field, "render_segments", "networks forward, composite"),
    (cpu_field, "render_segments_backward", "composite and networks back, position gradient"),
    (cpu_field, "ray_gradients", "sum into rays"),
    (cpu_field.encoding, "update_table", "table gradient and Adam"),
    (PoseParameters, "step", "Adam on poses"),
]
BEFORE = "every interval"  # the form without merging; counted with cells looked at by density
DEFINITION = "plain torch"


def _every_interval(ours: JointOptimiser) -> JointOptimiser:
    """The same optimisation with a sample in every live interval; shares photos, poses and field."""
    rival = copy.copy(ours)
    rival.method = replace(ours.method, merging=None)
    return rival


def _cells_s(ours: JointOptimiser, rounds: int, clock: Clock) -> dict[str, float]:
    """Seconds per step for the occupancy grid's updates, with estimated and with exact density."""
    estimate, field = ours.field.estimate, ours.field
    kept = {name: tensor.clone() for name, tensor in ours.occupancy.state().items()}

    def looked(density: Any) -> None:
        with patch.object(field, "estimate", density):
            ours._update_occupancy(ours.step_index)

    by_density = lambda position, count=None: field.density(position)  # noqa: E731
    seconds = interleave(
        {"estimate": lambda: looked(estimate), "density": lambda: looked(by_density)}, rounds, clock
    )
    ours.occupancy.load_state(kept)
    period = ours.schedule.numbers.occupancy_period
    return {name: float(np.median(each)) / period for name, each in seconds.items()}


def _definition(ours: JointOptimiser) -> JointOptimiser:
    """The same with the field that defines the kernels, trained equally far."""
    rival, field = _every_interval(ours), ReferenceField(ours.field.shape, 0, scene.CPU)
    field.load_state(ours.field.state())
    rival.field = field
    return rival


def _parts_ms(joint: JointOptimiser, rays: int, steps: int, clock: Clock) -> dict[str, float]:
    """Median times of a step's parts."""
    parts: dict[str, list[float]] = {}
    for _ in range(steps):
        with timed(OPERATIONS, clock) as spent:
            scene.step(joint, rays)
        for label, value in spent.items():
            parts.setdefault(label, []).append(value)
    return {label: 1e3 * float(np.median(values)) for label, values in parts.items()}


def run(rays: int, rounds: int, threads: int, clock: Clock, definition: bool) -> list[dict[str, Any]]:
    """One row per stage, at the paper's encodings."""
    rows: list[dict[str, Any]] = []
    for stage in ("coarse", "fine"):
        ours = scene.optimiser(stage, 100, threads, rays)
        samples = [scene.step(ours, rays) for _ in range(3)][-1]

        def torch_step(rival: JointOptimiser) -> None:
            torch.set_num_threads(threads)
            scene.step(rival, rays)
            torch.set_num_threads(1)

        unmerged = _every_interval(ours)
        competitors = {"kernels": lambda ours=ours: scene.step(ours, rays)}
        competitors[BEFORE] = lambda rival=unmerged: scene.step(rival, rays)
        if definition:
            plain = _definition(ours)
            competitors[DEFINITION] = lambda rival=plain: torch_step(rival)
        seconds = interleave(competitors, rounds, clock)
        with peak_memory() as memory:
            medians = _parts_ms(ours, rays, 3 * rounds, clock)
        cells = _cells_s(ours, rounds, clock)
        medians |= {f"occupancy, per step, by {name}": 1e3 * value for name, value in cells.items()}
        fast = float(np.median(seconds["kernels"])) + cells["estimate"]
        times_faster = {name: ratio(each, seconds["kernels"]) for name, each in seconds.items()}
        times_faster[BEFORE] = ratio(
            [s + cells["density"] for s in seconds[BEFORE]],
            [s + cells["estimate"] for s in seconds["kernels"]],
        )
        rows.append({
            "stage": stage, "rays": rays, "samples": samples, "kernels": summary(seconds["kernels"]),
            "ns_per_sample": 1e9 * fast / samples, "samples_per_s": samples / fast, "rays_per_s": rays / fast,
            "rivals": {name: summary(v) for name, v in seconds.items() if name != "kernels"},
            "times_faster": times_faster, "parts_ms": medians, "peak_added_mib": memory["added_mib"],
        })  # fmt: skip
    return rows
