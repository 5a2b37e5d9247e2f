"""How a step's time and the process's memory grow with rays and with images."""

from __future__ import annotations

import gc
from typing import Any

from benchmarks.speed import scene
from benchmarks.speed.clock import Clock, interleave, resident_mib, summary

RAYS = (256, 512, 1024, 2048, 4096, 8192)
IMAGES = (25, 100, 400, 1000)
SIZE = 200  # px, the working size of the preset `balanced`


def with_rays(rounds: int, threads: int, clock: Clock) -> list[dict[str, Any]]:
    """A stage-2 step of 256 to 8192 rays."""
    joint = scene.optimiser("fine", 100, threads, RAYS[0], SIZE, "balanced")
    samples = {}

    def steps(rays: int):
        def one() -> None:
            joint.rays = rays
            samples[rays] = scene.step(joint, rays)

        return one

    seconds = interleave({str(rays): steps(rays) for rays in RAYS}, rounds, clock)
    return [
        {"rays": rays, "samples": samples[rays], **summary(seconds[str(rays)]),
         "ns_per_sample": 1e9 * min(seconds[str(rays)]) / samples[rays]}
        for rays in RAYS
    ]  # fmt: skip


def with_images(rounds: int, threads: int, clock: Clock) -> list[dict[str, Any]]:
    """A stage-2 step of 1024 rays over 25 to 1000 photos, and the memory that they and the optimiser take."""
    held, memory = {}, {}
    for images in IMAGES:
        gc.collect()
        before = resident_mib()
        held[images] = scene.optimiser("fine", images, threads, 1024, SIZE, "balanced")
        scene.step(held[images], 1024)
        memory[images] = resident_mib() - before
    seconds = interleave({str(n): lambda j=j: scene.step(j, 1024) for n, j in held.items()}, rounds, clock)
    return [
        {"images": n, **summary(seconds[str(n)]), "photos_mib": held[n].sampler.pixels.numel() / 2**20,
         "optimiser_mib": memory[n], "process_mib": resident_mib()}
        for n in IMAGES
    ]  # fmt: skip
