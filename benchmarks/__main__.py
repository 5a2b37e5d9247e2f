"""`make bench`: prints the table and writes benchmarks/results.json."""

from __future__ import annotations

import argparse
import json
import platform
from pathlib import Path

import torch

from benchmarks import field_step


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description=__doc__)
    parser.add_argument("--rays", type=int, default=1024, help="rays of a step (default 1024)")
    parser.add_argument("--rounds", type=int, default=7, help="interleaved rounds (default 7)")
    parser.add_argument("--json", type=Path, default=Path("benchmarks/results.json"))
    arguments = parser.parse_args()
    rows = field_step.run(arguments.rays, arguments.rounds)
    if torch.cuda.is_available():
        from benchmarks import cuda_step

        rows += cuda_step.run(8 * arguments.rays, arguments.rounds)
    print(f"{'stage':12}{'samples':>9}{'kernels':>12}{'plain torch':>14}{'ratio':>8}{'ns/sample':>11}")
    for row in rows:
        print(
            f"{row['stage']:12}{row['samples']:>9}{row['kernels_ms']:>9.1f} ms{row['torch_ms']:>11.1f} ms"
            f"{row['ratio']:>8.1f}{row['kernels_ns_per_sample']:>11.0f}"
        )
    result = {"machine": platform.platform(), "rays": arguments.rays, "field_step": rows}
    arguments.json.write_text(json.dumps(result, indent=2) + "\n")


if __name__ == "__main__":
    main()
