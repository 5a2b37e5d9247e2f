"""`make bench`: prints the tables and writes benchmarks/results.json."""

from __future__ import annotations

import argparse
import json
import platform
from pathlib import Path
from typing import Any

import torch

from benchmarks.speed import training_step
from benchmarks.speed.clock import CLOCKS
from biresnerf.compile_kernels import compile_kernels
from biresnerf.field.backends import use_threads


def _print_steps(rows: list[dict[str, Any]]) -> None:
    for row in rows:
        ours = row["kernels"]
        print(
            f"\nStep, stage {row['stage']}, {row['rays']} rays, {row['samples']} samples: median "
            f"{ours['median_ms']:.1f} ms (min {ours['min_ms']:.1f}), {row['ns_per_sample']:.0f} ns/sample, "
            f"{row['samples_per_s'] / 1e6:.2f} M samples/s, {row['rays_per_s'] / 1e3:.1f} k rays/s"
        )
        for name, value in row["parts_ms"].items():
            print(f"    {name:50}{value:9.2f} ms{1e6 * value / row['samples']:9.0f} ns/sample")
        for name, value in row["rivals"].items():
            print(f"    {name:50}{value['median_ms']:9.0f} ms{row['times_faster'][name]:9.1f} x ours")
        print(f"    {'memory added in a step':50}{row['peak_added_mib']:9.0f} MiB")


def _print_cuda(rows: list[dict[str, Any]]) -> None:
    print(f"\n{'stage':12}{'samples':>9}{'kernels':>12}{'plain torch':>14}{'ratio':>8}{'ns/sample':>11}")
    for row in rows:
        print(
            f"{row['stage']:12}{row['samples']:>9}{row['kernels_ms']:>9.1f} ms{row['torch_ms']:>11.1f} ms"
            f"{row['ratio']:>8.1f}{row['kernels_ns_per_sample']:>11.0f}"
        )


def _machine(threads: int) -> dict[str, str | int]:
    cpu = Path("/proc/cpuinfo")
    lines = cpu.read_text().splitlines() if cpu.exists() else []
    models = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    model = models[0] if models else platform.processor()
    return {"cpu": model, "platform": platform.platform(), "threads": threads, "torch": torch.__version__}


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description=__doc__)
    parser.add_argument("--rays", type=int, default=1024, help="rays of a step (default 1024)")
    parser.add_argument("--rounds", type=int, default=7, help="interleaved rounds (default 7)")
    parser.add_argument("--threads", type=int, default=0, help="0: all cores")
    parser.add_argument("--clock", choices=list(CLOCKS), default="wall",
                        help="cpu counts processor time: with --threads 1, for a machine that others use")  # fmt: skip
    parser.add_argument("--definition", action="store_true", help="time the slow definition's whole step too")
    parser.add_argument("--json", type=Path, default=Path("benchmarks/results.json"))
    asked = parser.parse_args()
    threads = use_threads(asked.threads)
    compile_kernels()
    result: dict[str, Any] = {"machine": _machine(threads), "clock": asked.clock}
    print(f"{result['machine']['cpu']}, {threads} threads")
    steps = training_step.run(asked.rays, asked.rounds, threads, CLOCKS[asked.clock], asked.definition)
    result["steps"] = steps
    _print_steps(steps)
    if torch.cuda.is_available():
        from benchmarks.gpu import cuda_step

        result["cuda_steps"] = cuda_step.run(8 * asked.rays, asked.rounds)
        _print_cuda(result["cuda_steps"])
    asked.json.write_text(json.dumps(result, indent=2) + "\n")


if __name__ == "__main__":
    main()
