"""A synthetic scene for measurements, and its optimisation in the middle of either stage."""

from __future__ import annotations

from functools import cache

import numpy as np
import torch

from biresnerf.data.photos.images import ImageSet
from biresnerf.data.synthetic.scene import render_synthetic, synthetic_cameras, synthetic_focal
from biresnerf.geometry.camera.camera_models import Camera
from biresnerf.options.refine_options import RefineOptions
from biresnerf.refinement.numbers.scene import FrameNumbers
from biresnerf.refinement.optimise.joint_optimiser import JointOptimiser
from biresnerf.refinement.optimise.methods import Recipe
from biresnerf.refinement.scene.scene_frame import scene_frame

CPU = torch.device("cpu")
VIEWS, SEED = 25, 1  # that differ; of more photos, some are the same
STEPS = 400  # until the middle of stage 1; as many in stage 2


@cache
def _views(size: int) -> np.ndarray:
    """uint8 [VIEWS, size, size, 3]."""
    poses = synthetic_cameras(VIEWS, SEED)
    return np.stack([render_synthetic(pose, size, SEED)[0][..., :3] for pose in poses])


def photos(count: int, size: int) -> ImageSet:
    """Synthetic photos of `size` px a side."""
    camera = Camera("SIMPLE_PINHOLE", size, size, (synthetic_focal(size), size / 2, size / 2))
    return ImageSet(
        pixels=_views(size)[np.arange(count) % VIEWS].reshape(-1, 3),
        alpha=None,
        offsets=np.arange(count + 1) * size * size,
        widths=np.full(count, size, np.int32),
        heights=np.full(count, size, np.int32),
        cameras=(camera,) * count,
        background=np.ones(3, np.float32),
    )


def untrained(
    images: int, threads: int, size: int, preset: str, device: torch.device = CPU
) -> JointOptimiser:
    """An optimiser at the true poses; each stage is twice as long as it is trained here."""
    options = RefineOptions(preset=preset, device=device.type, max_image_size=size, steps=4 * STEPS)
    options = options.model_copy(update={"coarse_steps_max": 2 * STEPS}).resolved(device.type)
    photo_set, poses = photos(images, size), synthetic_cameras(VIEWS, SEED)[np.arange(images) % VIEWS]
    frame = scene_frame(poses, photo_set, FrameNumbers())
    start = frame.unit_from_world.apply_to_poses(poses)
    return JointOptimiser(photo_set, frame, start, Recipe.of(options, device, threads), [])


@cache
def _trained(stage: str, threads: int, size: int, preset: str) -> JointOptimiser:
    made = untrained(VIEWS, threads, size, preset)
    for _ in range(STEPS):
        made.step()
    if stage == "fine":
        made.start_reconstruction()
        for _ in range(STEPS):
            made.step()
    return made


def optimiser(
    stage: str, images: int, threads: int, rays: int, size: int = 200, preset: str = "paper"
) -> JointOptimiser:
    """An optimiser with the preset's encodings in the middle of a stage."""
    trained, made = _trained(stage, threads, size, preset), untrained(images, threads, size, preset)
    if stage == "fine":
        made.start_reconstruction()
        made.switch = trained.switch
    made.step_index = trained.step_index
    made.field.load_state(trained.field.state())
    made.occupancy.load_state(trained.occupancy.state())
    made.rays = rays
    return made


def step(joint: JointOptimiser, rays: int) -> int:
    """One training step without the occupancy update, always at the same point of the schedule.

    Returns its samples before any were merged.
    """
    index = joint.step_index
    joint.step_index += index % joint.schedule.numbers.occupancy_period == 0
    result = joint.step()
    joint.step_index, joint.rays = index, rays
    return result.samples
