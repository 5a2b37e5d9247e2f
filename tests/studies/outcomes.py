"""Made-up results of runs: real pose errors of rigs with known noise, made-up times."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from biresnerf.geometry.perturb import perturb_poses
from biresnerf.geometry.pose_error import pose_error
from biresnerf.options.refine_options import RefineOptions
from biresnerf.studies.cell import CameraResult, Cell, CellResult, Outcome, Perturbation, Scene, ViewQuality
from biresnerf.studies.plan import Entry
from tests.geometry.rigs import dome

TRUTH = dome(12, np.random.default_rng(4))


def scene(name: str = "dome") -> Scene:
    return Scene(name=name, file=Path("transforms.json"), test_file=None, digest=name)


def outcome(noise: float, seed: int = 1, psnr: float = 30.0, seconds: float = 8.0, **changed) -> Outcome:
    """As if a run had left this much noise; its stages take a quarter and three quarters of `seconds`."""
    error = pose_error(perturb_poses(TRUTH, noise, seed), TRUTH)
    values = {
        "version": "0",
        "options": RefineOptions(preset="fast").resolved("cpu"),
        "before": pose_error(perturb_poses(TRUTH, 0.15, seed), TRUTH),
        "after": error,
        "cameras": tuple(
            CameraResult(name=str(i), displaced=False, before_deg=10.0, after_deg=0.8 + 0.1 * i)
            for i in range(len(TRUTH))
        ),
        "views": ViewQuality(kind="test", count=5, psnr=psnr, ssim=0.9, lpips_absent="no weights"),
        "switch_step": 1200,
        "switch_reason": "stable",
        "seconds": {"preparing": 1.0, "coarse": 0.25 * seconds, "fine": 0.75 * seconds},
        "peak_memory_bytes": 300 * 2**20,
        "backend": "cpu",
        "device": "cpu",
        "threads": 2,
        "resumed": 0,
    }
    return Outcome(**{**values, **changed})


def entry(name: str, seed: int, variant: str, result: Outcome | str) -> Entry:
    start = Perturbation(noise=0.15, seed=seed)
    cell = Cell(scene=scene(name), start=start, options=RefineOptions(preset="fast", seed=seed))
    done = {"error": result} if isinstance(result, str) else {"outcome": result}
    return Entry(name, start, variant, CellResult(cell=cell, **done))
