"""Whole steps on a GPU, by their graphs and operation by operation: ``python -m benchmarks.gpu.whole_step``."""

from __future__ import annotations

import statistics
import time

import torch

from benchmarks.speed import scene
from biresnerf.refinement.optimise.joint_optimiser import JointOptimiser

FIRST, STEPS, ROUNDS = 200, 48, 5  # steps until the number of rays has settled; steps a round


def milliseconds(optimiser: JointOptimiser, steps: int, rays: int) -> float:
    """Of a step, with the host free to run ahead as it is in a run."""
    torch.cuda.synchronize()
    began = time.perf_counter()
    for _ in range(steps):
        optimiser.rays = rays
        optimiser.step()
    torch.cuda.synchronize()
    return 1e3 * (time.perf_counter() - began) / steps


def main() -> None:
    optimiser = scene.untrained(images=100, threads=1, size=200, preset="paper", device=torch.device("cuda"))
    graphs = optimiser.graphs
    assert graphs is not None
    for stage in ("coarse", "fine"):
        if stage == "fine":
            optimiser.start_reconstruction()
        for _ in range(FIRST):
            optimiser.step()
        rays, found = optimiser.rays, {True: [], False: []}
        for by_graph in (True, False) * (ROUNDS + 1):  # the first round records
            own, graphs.fault = graphs.fault, graphs.fault if by_graph else "not wanted here"
            found[by_graph].append(milliseconds(optimiser, STEPS, rays))
            graphs.fault = graphs.fault if by_graph else own
        one_by_one, by_graphs = (statistics.median(found[how][1:]) for how in (False, True))
        print(
            f"{stage}: {one_by_one:.2f} ms a step operation by operation, {by_graphs:.2f} ms by its graph, "
            f"{rays} rays; {graphs.repeated} steps repeated, fault: {graphs.fault}"
        )


if __name__ == "__main__":
    main()
