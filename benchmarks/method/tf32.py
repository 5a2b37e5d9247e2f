"""What products in TF32, as on a GPU, do to poses: ``python -m benchmarks.method.tf32 SCENE... [--seeds 1,2]``.

TF32 keeps 10 of float32's 23 bits of mantissa of both factors, and sums in float32. Here the CPU kernels of the
networks cut their factors so, and are compiled anew for it. Each SCENE is refined as `benchmarks.method.loss` does, in
float32 and then in TF32. Prints one JSON line per run.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path

from llvmlite import ir

KEPT = 0xFFFFE000  # sign, exponent and 10 bits of mantissa: tensor cores ignore the rest
CHILD = "--tf32-child"


def cut_factors() -> None:
    """Let every product of the networks' kernels ignore the last 13 bits of its factors."""
    from biresnerf.field.cpu import vector_tiles

    multiply = vector_tiles._add_product
    bits = ir.VectorType(ir.IntType(32), vector_tiles.LANES)
    mask = ir.Constant(bits, [KEPT] * vector_tiles.LANES)

    def cut(builder: ir.IRBuilder, vector: ir.Value) -> ir.Value:
        kept = builder.and_(builder.bitcast(vector, bits), mask)
        return builder.bitcast(kept, vector_tiles._vector)

    def multiply_cut(builder: ir.IRBuilder, accumulator: ir.Value, a: ir.Value, b: ir.Value) -> None:
        multiply(builder, accumulator, cut(builder, a), cut(builder, b))

    vector_tiles._add_product = multiply_cut


def run(scenes: list[Path], noise: float, seeds: str, settings: list[str], products: str) -> None:
    """Refine every scene with every seed."""
    from benchmarks.method.loss import refined
    from biresnerf.commands.settings_option import parse_settings
    from biresnerf.studies.scenes import find_scene

    for path in scenes:
        scene = find_scene(path, 1, test_views=0)
        for seed in map(int, seeds.split(",")):
            errors = refined(scene, noise, seed, parse_settings(tuple(settings)))
            print(json.dumps({"scene": scene.name, "seed": seed, "products": products, **errors}), flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scenes", type=Path, nargs="+")
    parser.add_argument("--noise", type=float, default=0.15)
    parser.add_argument("--seeds", default="1,2")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE")
    parser.add_argument(CHILD, action="store_true", help=argparse.SUPPRESS)
    asked = parser.parse_args()
    if asked.tf32_child:
        cut_factors()
        run(asked.scenes, asked.noise, asked.seeds, asked.set, "tf32")
        return
    run(asked.scenes, asked.noise, asked.seeds, asked.set, "float32")
    with tempfile.TemporaryDirectory() as kernels:  # Numba would take float32's from its cache
        command = [sys.executable, "-m", "benchmarks.method.tf32", CHILD, *sys.argv[1:]]
        subprocess.run(command, env={**os.environ, "NUMBA_CACHE_DIR": kernels}, check=True)


if __name__ == "__main__":
    main()
