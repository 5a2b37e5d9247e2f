"""COLMAP on sets of known poses: ``python -m benchmarks.method.peers SET... [--noise 0.15] [--seed 1]``.

Each SET is read, and its poses are made noisy, as by ``biresnerf compare``. COLMAP, with its own options, sees the same
photos and masks at full size and holds the same lens: incremental mapping, the same with the noisy positions as priors,
and global mapping, which takes none. They share features and matches. Prints a JSON line for each, then a table:
cameras placed; their mean and worst rotation (deg) and mean centre (percent of the distance) after BARF's alignment;
seconds.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from biresnerf.data.model.dataset import Dataset
from biresnerf.data.seeding.map_images import lay_out, read_mapping
from biresnerf.geometry.pose_error import pose_error
from biresnerf.studies.cell import Perturbation
from biresnerf.studies.scenes import find_scene, read_scene, starting_rig, with_poses

Line = dict[str, Any]
PEERS = {
    "incremental": ("incremental", False),
    "incremental, priors": ("incremental", True),
    "global": ("global", False),
}
HEADING = ("set", "cameras", "features, matching", *PEERS)


def asked(step: str, request: dict[str, Any]) -> dict[str, Any]:
    """The answer of `peers_child`; ``error`` if COLMAP itself failed."""
    work = Path(request["work"])
    path, answer, log = work / "request.json", work / "answer.json", work / "colmap.log"
    answer.unlink(missing_ok=True)
    path.write_text(json.dumps({**request, "step": step, "answer": str(answer)}), "utf-8")
    with log.open("wb") as said:
        command = [sys.executable, "-m", "benchmarks.method.peers_child", str(path)]
        code = subprocess.run(command, stdout=said, stderr=said, check=False).returncode
    if code != 0:
        last = log.read_text("utf-8", errors="replace").strip().splitlines()[-1:]
        return {"error": f"ended with {code}: {' '.join(last)}"}
    found: dict[str, Any] = json.loads(answer.read_text("utf-8"))
    return found


def measured(name: str, truth: Dataset, given: Dataset, seed: int) -> Iterator[Line]:
    """A line for each peer, on a set with true poses and its noisy copy."""
    with tempfile.TemporaryDirectory(prefix="biresnerf-benchmark-") as work:
        request = {**lay_out(given, Path(work)), "seed": seed}
        matches = asked("match", request)
        if "error" in matches:
            raise SystemExit(f"{name}: COLMAP {matches['error']}")
        shared = {key: matches[key] for key in ("pairs", "features_s", "matching_s")}
        for peer, (mapper, priors) in PEERS.items():
            each = {**request, "numbers": matches["numbers"], "mapper": mapper, "priors": priors}
            found = asked("place", each)
            yield {"set": name, "cameras": len(truth), **shared, "peer": peer, **errors(truth, found)}


def errors(truth: Dataset, found: dict[str, Any]) -> Line:
    """The errors of the placed cameras, after alignment by them."""
    if "error" in found:
        return {"placed": 0, "error": found["error"]}
    line = {"placed": 0, "seconds": found["seconds"]}
    for model in read_mapping(truth, found).models:
        error = pose_error(model.world_from_cam, truth.world_from_cam[model.rows]).aligned
        line |= {
            "placed": len(model.rows),
            "rotation_deg": error.rotation_deg.mean,
            "worst_deg": error.rotation_deg.max,
            "centre_percent": error.centre_percent.mean,
        }
    return line


def table(lines: list[Line]) -> str:
    """Markdown, a row for each set."""
    rows = [HEADING, ("---",) * len(HEADING)]
    for name in dict.fromkeys(line["set"] for line in lines):
        own = {line["peer"]: line for line in lines if line["set"] == name}
        first = next(iter(own.values()))
        shared = f"{first['features_s']:.0f} + {first['matching_s']:.0f} s"
        rows.append((name, str(first["cameras"]), shared, *(_cell(line) for line in own.values())))
    return "\n".join(f"| {' | '.join(row)} |" for row in rows)


def _cell(line: Line) -> str:
    if "error" in line:
        return "failed"
    if not line["placed"]:
        return f"none, {line['seconds']:.0f} s"
    return (
        f"{line['placed']}: {line['rotation_deg']:.3f}° (at most {line['worst_deg']:.2f}°), "
        f"{line['centre_percent']:.3f} %, {line['seconds']:.0f} s"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("sets", nargs="+", type=Path)
    parser.add_argument("--noise", type=float, default=0.15)
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    lines = []
    for path in options.sets:
        scene = find_scene(path, every=1, test_views=0)
        truth = read_scene(scene)
        rig = starting_rig(truth.world_from_cam, Perturbation(noise=options.noise, seed=options.seed))
        for line in measured(path.name, truth, with_poses(truth, rig.world_from_cam), options.seed):
            lines.append({k: round(v, 4) if isinstance(v, float) else v for k, v in line.items()})
            print(json.dumps(lines[-1]), flush=True)
    print(table(lines))


if __name__ == "__main__":
    main()
