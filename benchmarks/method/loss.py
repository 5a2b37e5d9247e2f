"""Which loss refines poses best: ``python -m benchmarks.method.loss SCENE... [--losses squared,huber:0.1]``.

Each SCENE holds true poses, which are made wrong by BARF's noise and refined with every loss in turn. Prints one JSON
line per run, with errors after BARF's alignment.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from dataclasses import replace
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from torch.nn.functional import huber_loss

from biresnerf.commands.settings_option import parse_settings
from biresnerf.data.formats.read_dataset import read_poses
from biresnerf.geometry.pose_error import pose_error
from biresnerf.options.refine_options import parse_options
from biresnerf.pipeline import refine_poses
from biresnerf.refinement.optimise import methods
from biresnerf.refinement.optimise.methods import Loss, half_squared_error
from biresnerf.studies.cell import Perturbation, Scene
from biresnerf.studies.scenes import find_scene, read_scene, starting_rig, with_poses


def loss_of(text: str) -> Loss:
    """`squared`, or `huber:DELTA`: half the square up to a residual of DELTA, linear beyond."""
    name, _, delta = text.partition(":")
    if name == "squared":
        return half_squared_error
    return partial(huber_loss, reduction="none", delta=float(delta))


def refined(scene: Scene, noise: float, seed: int, settings: dict[str, Any]) -> dict[str, Any]:
    """Errors of one run."""
    dataset = read_scene(scene)
    truth = dataset.world_from_cam
    start = starting_rig(truth, Perturbation(noise=noise, seed=seed)).world_from_cam
    fixed = {"start": "given", "orbit_frames": 0, "verdict": False, "shown_views": 1}
    options = parse_options({"preset": "fast", "seed": seed, **fixed, **settings})
    with tempfile.TemporaryDirectory() as folder:
        output = Path(folder) / "out"
        report = refine_poses(with_poses(dataset, start), output, options)
        error = pose_error(np.stack(list(read_poses(output / "transforms.json").values())), truth).aligned
    return {
        "rotation_deg": round(error.rotation_deg.mean, 3),
        "median_deg": round(error.rotation_deg.median, 3),
        "max_deg": round(error.rotation_deg.max, 2),
        "centre_percent": round(error.centre_percent.mean, 3),
        "unseen_psnr": round(report.heldout.psnr, 2) if report.heldout else None,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scenes", type=Path, nargs="+")
    parser.add_argument("--losses", default="squared,huber:0.1,huber:0.03")
    parser.add_argument("--noise", type=float, default=0.15)
    parser.add_argument("--seeds", default="1,2")
    parser.add_argument("--every", type=int, default=1, help="Use each n-th view.")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE")
    asked = parser.parse_args()
    ours, settings = methods.BIRESNERF, parse_settings(tuple(asked.set))
    for seed, path, loss in product(asked.seeds.split(","), asked.scenes, asked.losses.split(",")):
        methods.BIRESNERF = replace(ours, loss=loss_of(loss))
        scene = find_scene(path, asked.every, test_views=0)
        errors = refined(scene, asked.noise, int(seed), settings)
        print(json.dumps({"scene": scene.name, "seed": int(seed), "loss": loss, **errors}), flush=True)


if __name__ == "__main__":
    main()
