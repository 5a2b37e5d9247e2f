"""`make bench`: prints the tables and writes benchmarks/results.json."""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

import torch

from benchmarks.speed import encodings, machine, scaling, training_step
from benchmarks.speed.clock import CLOCKS
from biresnerf.compile_kernels import compile_kernels
from biresnerf.field.backends import use_threads

TABLE_BYTES = 16 * 2**19 * 8  # of the paper's reconstruction module


def _print_encodings(rows: list[dict[str, Any]]) -> None:
    for row in rows:
        print(f"\nEncoding, {row['module']}, {row['samples']} samples: {row['ns_per_sample']:.0f} ns/sample")
        for name, value in row["parts_ns"].items():
            print(f"    {name:38}{value:9.1f} ns/sample")
        for name, value in row["torch_ms"].items():
            times = row["times_faster"][name]
            print(
                f"    {'torch, ' + name:38}{1e6 * value / row['samples']:9.0f} ns/sample{times:8.1f} x ours"
            )
        yardstick = row["times_the_yardstick"]
        print(f"    {'ours / C++ yardstick':38}{yardstick:9.2f}" if yardstick else "    no g++: no yardstick")
        print(f"    {'share of the random-read limit':38}{row['share_of_random_reads']:9.2f}")


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
            label = name if name == training_step.BEFORE else f"torch, {name}"
            print(f"    {label:50}{value['median_ms']:9.0f} ms{row['times_faster'][name]:9.1f} x ours")
        print(f"    {'share of the multiply-add limit, networks':50}{row['share_of_gflops']:9.2f}")
        added, slow = row["peak_added_mib"], row["peak_added_mib_unrolled"]
        print(f"    {'memory added in a step':50}{added:9.0f} MiB (torch, unrolled: {slow:.0f} MiB)")


def _print_cuda(rows: list[dict[str, Any]]) -> None:
    print(f"\n{'stage':12}{'samples':>9}{'kernels':>12}{'plain torch':>14}{'ratio':>8}{'ns/sample':>11}")
    for row in rows:
        print(
            f"{row['stage']:12}{row['samples']:>9}{row['kernels_ms']:>9.1f} ms{row['torch_ms']:>11.1f} ms"
            f"{row['ratio']:>8.1f}{row['kernels_ns_per_sample']:>11.0f}"
        )


def _print_scaling(result: dict[str, list[dict[str, Any]]]) -> None:
    print("\n    rays  samples    median       min  ns/sample (min)")
    for row in result["rays"]:
        print(f"{row['rays']:8}{row['samples']:9}{row['median_ms']:7.1f} ms{row['min_ms']:7.1f} ms"
              f"{row['ns_per_sample']:10.0f}")  # fmt: skip
    print("\n  images    median       min    photos  optimiser with photos")
    for row in result["images"]:
        print(f"{row['images']:8}{row['median_ms']:7.1f} ms{row['min_ms']:7.1f} ms{row['photos_mib']:6.0f} MiB"
              f"{row['optimiser_mib']:10.0f} MiB")  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description=__doc__)
    what = ["encodings", "steps", "scaling"]
    parser.add_argument(
        "what", nargs="*", choices=[*what, []], help=f"any of {', '.join(what)} (default: all)"
    )
    parser.add_argument("--rays", type=int, default=1024, help="rays of a step (default 1024)")
    parser.add_argument("--samples", type=int, default=1 << 16, help="points to encode (default 65536)")
    parser.add_argument("--rounds", type=int, default=7, help="interleaved rounds (default 7)")
    parser.add_argument("--threads", type=int, default=0, help="0: all cores")
    parser.add_argument("--clock", choices=list(CLOCKS), default="wall",
                        help="cpu counts processor time: with --threads 1, for a machine that others use")  # fmt: skip
    parser.add_argument("--definition", action="store_true", help="time the slow definition's whole step too")
    parser.add_argument("--json", type=Path, default=Path("benchmarks/results.json"))
    arguments = parser.parse_args()
    chosen, clock = arguments.what or what, CLOCKS[arguments.clock]
    threads = use_threads(arguments.threads)
    compile_kernels()
    limit = machine.limits(threads, clock, TABLE_BYTES)
    result: dict[str, Any] = {"machine": machine.describe(threads), "clock": arguments.clock, "limits": limit}
    print(f"{result['machine']['cpu']}, {threads} threads: {limit['random_reads_per_s'] / 1e6:.0f} M random reads/s "
          f"of {TABLE_BYTES >> 20} MiB, {limit['gflops']:.0f} GFLOP/s")  # fmt: skip
    if "encodings" in chosen:
        result["encodings"] = encodings.run(arguments.samples, arguments.rounds, threads, clock, limit)
        _print_encodings(result["encodings"])
    if "steps" in chosen:
        result["steps"] = training_step.run(
            arguments.rays, arguments.rounds, threads, clock, limit, arguments.definition
        )
        _print_steps(result["steps"])
        if torch.cuda.is_available():
            from benchmarks.gpu import cuda_step

            result["cuda_steps"] = cuda_step.run(8 * arguments.rays, arguments.rounds)
            _print_cuda(result["cuda_steps"])
    if "scaling" in chosen:
        result["scaling"] = {
            "rays": scaling.with_rays(arguments.rounds, threads, clock),
            "images": scaling.with_images(arguments.rounds, threads, clock),
        }
        _print_scaling(result["scaling"])
    arguments.json.write_text(json.dumps(result, indent=2) + "\n")


if __name__ == "__main__":
    main()
