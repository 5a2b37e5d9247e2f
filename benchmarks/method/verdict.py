"""The verdict's trainings on two sets of poses: ``python -m benchmarks.method.verdict SCENE BEFORE AFTER``.

SCENE holds true poses. BEFORE and AFTER are each a file of poses, `truth`, or `noise:LEVEL:SEED` (BARF's noise on the
truth). All are tied to the scene's frame first.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import torch

from biresnerf.compile_kernels import compile_kernels
from biresnerf.data.formats.read_dataset import read_dataset, read_poses
from biresnerf.data.model.dataset import Dataset
from biresnerf.data.photos.images import load_images
from biresnerf.field.backends import use_threads
from biresnerf.geometry.perturb import perturb_poses
from biresnerf.geometry.pose_error import pose_error
from biresnerf.geometry.similarity import align_robust
from biresnerf.options.refine_options import RefineOptions
from biresnerf.refinement.optimise.methods import Recipe, find_method
from biresnerf.refinement.views.compare_rigs import Rig, compare_on_unseen_views, moved_px
from biresnerf.refinement.views.held_out_views import held_out_views


def poses_of(text: str, dataset: Dataset) -> np.ndarray:
    """world_from_cam [n, 4, 4] in the frame of the scene's true poses."""
    truth = dataset.world_from_cam
    if text == "truth":
        return truth
    if text.startswith("noise:"):
        _, level, seed = text.split(":")
        poses = perturb_poses(truth, float(level), seed=int(seed))
    else:
        by_stem = {Path(name).stem: pose for name, pose in read_poses(Path(text)).items()}
        poses = np.stack([by_stem[Path(name).stem] for name in dataset.names])
    return align_robust(poses, truth, with_rotations=True).apply_to_poses(poses)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scene", type=Path)
    parser.add_argument("before")
    parser.add_argument("after")
    parser.add_argument("--size", type=int, default=100, help="Long side of the photos, px.")
    parser.add_argument("--steps", type=int, default=200)
    parser.add_argument("--seeds", type=int, default=1)
    asked = parser.parse_args()
    dataset = read_dataset(asked.scene)
    images = load_images(dataset, asked.size)
    cameras = tuple(dataset.camera_of(i) for i in range(len(dataset)))
    before, after = (Rig(poses_of(text, dataset), cameras) for text in (asked.before, asked.after))
    compile_kernels()
    for name, rig in (("before", before), ("after", after)):
        error = pose_error(rig.world_from_cam, dataset.world_from_cam).aligned
        print(f"{name}: {error.rotation_deg.mean:.3f} deg, {error.centre_percent.mean:.2f} % of the distance")
    print(f"moved: {moved_px(before, after, images):.2f} px")
    for seed in range(asked.seeds):
        options = RefineOptions(
            preset="fast", device="cpu", seed=seed, max_image_size=asked.size, trial_steps=asked.steps
        ).resolved("cpu")
        found = compare_on_unseen_views(
            (before, after), images, held_out_views(len(dataset), "auto", find_method("biresnerf").views),
            np.ones(len(dataset), np.bool_),
            Recipe.of(options, torch.device("cpu"), use_threads(0)), lambda: False,
        )  # fmt: skip
        if found is None:
            raise SystemExit("too few images")
        for figure in ("psnr", "ssim"):
            print(f"seed {seed}, {figure}: {getattr(found.evidence, figure).model_dump_json()}")
        print(f"seed {seed}, missed: {found.evidence.missed_px:.2f} px")


if __name__ == "__main__":
    main()
