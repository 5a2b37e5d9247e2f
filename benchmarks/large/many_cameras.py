"""Time and accuracy of adjusting many cameras: ``python -m benchmarks.large.many_cameras``.

``--shapes ring corridor aerial --counts 100 300 1000 3000 --by sparse dense ceres``: the rigs of `camera_rigs`, each
adjusted in its own process, on one thread, by our fronts, by one dense system (``dense``, the same code with all
cameras in one front), and by Ceres with the same priors (needs the package pyceres; robust by Cauchy's loss, with the
noise known, which ours measures).

Prints for each the cost of our objective per observation, processor seconds and memory, both with their ratio to the
first of ``--by``, and mean errors of rotations and centres. For ours also the seconds for the uncertainties, the share
of centres within their bounds without `track_model_error`, and the largest difference from the dense covariances.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import time
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.large.camera_rigs import NOISE_PX, SHAPES, Rig, rig
from biresnerf.geometry.pose_error import camera_errors
from biresnerf.geometry.similarity import align_by_spread
from biresnerf.refinement.adjustment.adjustment import adjust_poses
from biresnerf.refinement.adjustment.cameras import Cameras
from biresnerf.refinement.adjustment.solver import dissection
from biresnerf.refinement.adjustment.solver.solve import Prior
from biresnerf.refinement.adjustment.track_term import TrackTerm
from biresnerf.refinement.finish.expected_errors import expected_errors
from biresnerf.refinement.numbers.finish import EvidenceNumbers
from biresnerf.studies.run_cell import peak_memory_bytes

Array = NDArray[np.float64]

ONE_THREAD = dict.fromkeys(
    ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS"), "1"
)
HEAD = (
    "| rig | cameras | by | cost | adjusted | memory | rotation, centre | uncertainty | within | off the dense |\n"
    "|---|---|---|---|---|---|---|---|---|---|"
)


def measured(shape: str, count: int, by: str, out: Path) -> dict[str, Any]:
    """The figures of one adjustment in this process; covariances go to a file."""
    given = rig(shape, count)
    if by == "dense":
        dissection.ONE_FRONT = 1 << 30
    before, began = peak_memory_bytes(), time.process_time()
    poses = _by_ceres(given) if by == "ceres" else _by_fronts(given)
    found = {"seconds": time.process_time() - began}
    if by != "ceres":
        began = time.process_time()
        errors = expected_errors(poses, poses, given.evidence)
        found["uncertainty"] = time.process_time() - began
        off = camera_errors(align_by_spread(given.truth, poses).apply_to_poses(given.truth), poses)
        found["within"] = float(
            (off.centre <= errors.bounds_90()[1] / EvidenceNumbers().track_model_error).mean()
        )
        np.save(out, errors.covariance)
    found["memory"] = peak_memory_bytes() - before
    off = camera_errors(align_by_spread(poses, given.truth).apply_to_poses(poses), given.truth)
    found |= {"rotation": float(off.rotation_deg.mean()), "centre": float(off.centre.mean())}
    return found | {"cost": _cost(given, poses)}


def _by_fronts(given: Rig) -> Array:
    return adjust_poses(given.given, given.evidence, given.prior).world_from_cam


def _by_ceres(given: Rig) -> Array:
    from benchmarks.method.ceres_child import adjusted

    return adjusted(given)


def _cost(given: Rig, poses: Array) -> float:
    """The cost of our objective with the true noise, per observation."""
    cameras, tracks = Cameras.of(poses), given.evidence.tracks
    assert tracks is not None
    term = TrackTerm(tracks, given.evidence.intrinsics, cameras, NOISE_PX)
    term.settle(cameras)
    total = term.cost(cameras, term.unknowns) + Prior.of(given.prior).cost(cameras)
    return total / len(tracks.point)


def _row(shape: str, count: int, by: str, found: dict[str, Any], first: dict[str, Any], off: str) -> str:
    ours, memory = found["seconds"], found["memory"]
    told = ("–", "–")
    if "within" in found:
        told = f"{found['uncertainty']:.1f} s", f"{100 * found['within']:.0f} %"
    return (
        f"| {shape} | {count} | {by} | {found['cost']:.5f} | {ours:.1f} s, {ours / first['seconds']:.2f} "
        f"| {memory / 1e6:.0f} MB, {memory / first['memory']:.2f} "
        f"| {found['rotation']:.4f}°, {found['centre']:.5f} | {told[0]} | {told[1]} | {off} |"
    )


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--shapes", nargs="+", default=list(SHAPES), choices=SHAPES)
    parser.add_argument("--counts", nargs="+", type=int, default=[100, 300])
    parser.add_argument("--by", nargs="+", default=["sparse", "dense"], choices=("sparse", "dense", "ceres"))
    parser.add_argument("--child", nargs=2, help=argparse.SUPPRESS)
    asked = parser.parse_args()
    if asked.child:
        _by_fronts(rig("ring", 12))  # compiles
        found = measured(asked.shapes[0], asked.counts[0], asked.by[0], Path(asked.child[1]))
        Path(asked.child[0]).write_text(json.dumps(found))
        return
    print(HEAD)
    with TemporaryDirectory() as folder:
        for shape, count in ((shape, count) for shape in asked.shapes for count in asked.counts):
            all_found, covariances = {}, {}
            for by in asked.by:
                files = [str(Path(folder, name)) for name in (f"{by}.json", f"{by}.npy")]
                command = [
                    sys.executable,
                    "-m",
                    "benchmarks.large.many_cameras",
                    "--shapes",
                    shape,
                    "--counts",
                    str(count),
                ]
                subprocess.run(
                    [*command, "--by", by, "--child", *files], check=True, env=os.environ | ONE_THREAD
                )
                all_found[by] = json.loads(Path(files[0]).read_text())
                covariances[by] = np.load(files[1]) if by != "ceres" else None
                print(
                    _row(shape, count, by, all_found[by], all_found[asked.by[0]], _off(covariances, by)),
                    flush=True,
                )


def _off(covariances: dict[str, Any], by: str) -> str:
    """The largest difference between sparse and dense covariances, in standard deviations."""
    if by == "ceres" or len(covariances) < 2 or covariances.get("dense") is None:
        return "–"
    sparse, dense = covariances["sparse"], covariances["dense"]
    deviation = np.sqrt(np.diagonal(dense, axis1=1, axis2=2))
    off = np.abs(sparse - dense) / (deviation[:, :, None] * deviation[:, None, :])
    return f"{np.nanmax(off):.1e}"


if __name__ == "__main__":
    main()
