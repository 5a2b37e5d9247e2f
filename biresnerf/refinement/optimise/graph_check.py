"""Checks that this GPU repeats recorded steps as they were taken, on a small scene.

``python -m biresnerf.refinement.optimise.graph_check`` prints what is wrong as a JSON list. `graph_faults` runs it once
for each GPU, driver and version, in its own process, as a GPU that fails while it records takes its process along.
"""

from __future__ import annotations

import json

import numpy as np
import torch

from biresnerf.data.photos.images import ImageSet
from biresnerf.data.synthetic.scene import render_synthetic, synthetic_cameras, synthetic_focal
from biresnerf.geometry.camera.camera_models import Camera
from biresnerf.options.refine_options import RefineOptions
from biresnerf.refinement.optimise.joint_optimiser import JointOptimiser
from biresnerf.refinement.optimise.step_graphs import StepGraphs
from biresnerf.refinement.scene.scene_frame import scene_frame

STEPS = 40  # of each stage
VIEWS, SIZE = 6, 32
RAYS = 512


def faults(optimiser: JointOptimiser, steps: int = STEPS) -> tuple[str, ...]:
    """What is wrong with the graphs of an optimiser that has taken no step."""
    graphs = optimiser.graphs
    assert graphs is not None
    for stage in (1, 2):
        before = graphs.repeated
        for _ in range(steps):
            optimiser.rays = RAYS
            optimiser.step()
        if graphs.fault is not None:
            return (graphs.fault,)
        if graphs.repeated == before:
            return (f"no step of stage {stage} could be repeated",)
        if stage == 1:
            optimiser.start_reconstruction()
    return ()


def small_optimiser(device: torch.device) -> JointOptimiser:
    """On a made scene, from its true poses."""
    poses = synthetic_cameras(VIEWS, 1)
    photos = np.stack([render_synthetic(pose, SIZE, 1)[0][..., :3] for pose in poses])
    images = ImageSet(
        pixels=photos.reshape(-1, 3),
        alpha=None,
        offsets=np.arange(VIEWS + 1) * SIZE * SIZE,
        widths=np.full(VIEWS, SIZE, np.int32),
        heights=np.full(VIEWS, SIZE, np.int32),
        cameras=(Camera("SIMPLE_PINHOLE", SIZE, SIZE, (synthetic_focal(SIZE), SIZE / 2, SIZE / 2)),) * VIEWS,
        background=np.ones(3, np.float32),
    )
    options = RefineOptions(preset="fast", device="cuda", steps=4 * STEPS, max_image_size=SIZE)
    frame = scene_frame(poses, images)
    start = frame.unit_from_world.apply_to_poses(poses)
    return JointOptimiser(images, frame, start, options.resolved("cuda"), [0], device, threads=1)


def check() -> tuple[str, ...]:
    """What is wrong with the graphs of steps on this GPU."""
    optimiser = small_optimiser(torch.device("cuda"))
    optimiser.graphs = StepGraphs(optimiser, check=tuple)  # this is the check
    return faults(optimiser)


if __name__ == "__main__":
    print(json.dumps(check()))  # noqa: T201
