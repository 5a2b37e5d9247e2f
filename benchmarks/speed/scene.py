"""A scene made up for measuring: random photos from cameras around a shell that alone holds anything."""

from __future__ import annotations

import numpy as np
import torch

from biresnerf.data.photos.images import ImageSet
from biresnerf.geometry.camera.camera_models import Camera
from biresnerf.options.refine_options import RefineOptions
from biresnerf.refine.optimise.joint_optimiser import JointOptimiser
from biresnerf.refine.scene.scene_frame import scene_frame

CPU = torch.device("cpu")
DISTANCE, FOCAL = 4.0, 1.4  # of the cameras; in widths of the photo


def photos(count: int, size: int) -> ImageSet:
    """Random uint8 photos of `size` px a side."""
    rng = np.random.default_rng(count)
    camera = Camera("SIMPLE_PINHOLE", size, size, (FOCAL * size, size / 2, size / 2))
    return ImageSet(
        pixels=rng.integers(0, 256, (count * size * size, 3), dtype=np.uint8),
        alpha=None,
        offsets=np.arange(count + 1) * size * size,
        widths=np.full(count, size, np.int32),
        heights=np.full(count, size, np.int32),
        cameras=(camera,) * count,
        background=np.ones(3, np.float32),
    )


def cameras_around(count: int) -> np.ndarray:
    """world_from_cam [count, 4, 4] spread evenly over a sphere, looking at its centre."""
    height = 1 - (2 * np.arange(count) + 1) / count
    turn = np.pi * (1 + 5**0.5) * np.arange(count)
    ring = np.sqrt(1 - height**2)
    centre = DISTANCE * np.stack([ring * np.cos(turn), ring * np.sin(turn), height], 1)
    forward = -centre / DISTANCE
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, :3, :3] = np.stack([right, np.cross(forward, right), forward], 2)
    poses[:, :3, 3] = centre
    return poses


def shell(side: int) -> torch.Tensor:
    """An occupancy grid that is live in a spherical shell: some 40 samples a ray, as after pruning."""
    centre = (torch.arange(side) + 0.5) / side - 0.5
    z, y, x = torch.meshgrid(centre, centre, centre, indexing="ij")
    radius = (x * x + y * y + z * z).sqrt()
    return ((radius - 0.33).abs() < 0.02).to(torch.uint8)


def optimiser(
    stage: str, images: int, threads: int, rays: int, size: int = 200, preset: str = "paper"
) -> JointOptimiser:
    """An optimiser of the given preset in the middle of a stage, with the shell as its occupancy."""
    options = RefineOptions(preset=preset, device="cpu", max_image_size=size).resolved("cpu")
    photo_set, poses = photos(images, size), cameras_around(images)
    frame = scene_frame(poses, photo_set)
    start = frame.unit_from_world.apply_to_poses(poses)
    made = JointOptimiser(photo_set, frame, start, options, [], CPU, threads)
    made.occupancy.occupied = shell(made.occupancy.side)
    made.step_index = options.coarse_steps_max - 1
    if stage == "fine":
        made.start_reconstruction()
        made.step_index += 3 * options.warmup_steps + 1
    made.rays = rays
    return made


def step(joint: JointOptimiser, rays: int) -> int:
    """One step of the whole training without the occupancy update, at the same place of the schedule each time.

    Returns its samples.
    """
    index = joint.step_index
    result = joint.step()
    joint.step_index, joint.rays = index, rays
    return result.samples
