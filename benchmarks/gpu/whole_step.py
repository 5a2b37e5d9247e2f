"""One step of the whole optimisation on a GPU, photos to poses, and where its time goes.

``python -m benchmarks.gpu.whole_step`` prints a JSON line for each preset and stage; with ``--profile``, the operations
of a step that take the device and the host longest. If the host never waits (``cudaEventSynchronize``), launches cost
more than the work itself.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Iterator

import torch

from benchmarks.speed import scene
from biresnerf.refinement.optimise.joint_optimiser import JointOptimiser

IMAGES, SIZE = 100, 400
WARM, TIMED, PROFILED = 300, 200, 32  # steps


def stages(preset: str, device: torch.device) -> Iterator[tuple[str, JointOptimiser]]:
    """The optimisation of a made scene, trained a while in either stage."""
    joint = scene.untrained(IMAGES, 8, SIZE, preset, device)
    for stage in ("coarse", "fine"):
        if stage == "fine":
            joint.start_reconstruction()
        for _ in range(WARM):
            joint.step()
        yield stage, joint


def wait_for(device: torch.device) -> None:
    if device.type == "cuda":
        torch.cuda.synchronize()


def row(preset: str, stage: str, joint: JointOptimiser) -> dict[str, float | str]:
    """A row of means: medians would hide the updates of the occupancy grid."""
    wait_for(joint.device)
    began, rays, samples = time.perf_counter(), 0, 0
    for _ in range(TIMED):
        done = joint.step()
        rays, samples = rays + done.rays, samples + done.samples
    wait_for(joint.device)
    ended = time.perf_counter()
    return {
        "device": joint.device.type,
        "preset": preset,
        "stage": stage,
        "step_ms": round(1e3 * (ended - began) / TIMED, 3),
        "rays": rays // TIMED,
        "samples": samples // TIMED,
        "ns_per_sample": round(1e9 * (ended - began) / samples, 2),
        "error": done.mean_squared_error,
    }


def profile(joint: JointOptimiser) -> str:
    """Device and host times of a step's operations, from torch's profiler."""
    from torch.profiler import ProfilerActivity
    from torch.profiler import profile as watch

    with watch(activities=[ProfilerActivity.CPU, ProfilerActivity.CUDA]) as seen:
        for _ in range(PROFILED):
            joint.step()
        wait_for(joint.device)
    found = seen.key_averages()
    lines = [f"{PROFILED} steps"]
    for by in ("self_device_time_total", "self_cpu_time_total"):
        lines.append(f"by {by}, ms a step and calls a step")
        for event in sorted(found, key=lambda e: -getattr(e, by))[:28]:
            spent, calls = getattr(event, by) / 1e3 / PROFILED, event.count / PROFILED
            lines.append(f"{spent:9.4f} {calls:7.1f}  {event.key[:80]}")
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--presets", default="fast,balanced,paper")
    parser.add_argument("--device", default="cuda")
    parser.add_argument("--profile", action="store_true")
    asked = parser.parse_args()
    for preset in asked.presets.split(","):
        for stage, joint in stages(preset, torch.device(asked.device)):
            print(json.dumps(row(preset, stage, joint)), flush=True)
            if asked.profile:
                print(f"{preset}, {stage}: {profile(joint)}", flush=True)


if __name__ == "__main__":
    main()
