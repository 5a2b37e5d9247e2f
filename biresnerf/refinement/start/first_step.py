"""From initial poses to the optimisation at its first step."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from biresnerf.data.model.dataset import Dataset
from biresnerf.data.seeding.initial_poses import InitialPoses
from biresnerf.data.workload import can_be_adjusted, matched_lengths
from biresnerf.errors import InputError
from biresnerf.machine import free_memory
from biresnerf.options.refine_options import RefineOptions
from biresnerf.refinement.adjustment.adjustment import adjustment_bytes
from biresnerf.refinement.optimise.joint_optimiser import JointOptimiser
from biresnerf.refinement.optimise.methods import Method, Recipe
from biresnerf.refinement.parameters.intrinsics_parameters import lenses_of
from biresnerf.refinement.parameters.rigid_bodies import rigid_bodies
from biresnerf.refinement.scene.scene import Scene
from biresnerf.refinement.scene.scene_depth import matched_depth
from biresnerf.refinement.scene.scene_frame import scene_frame

TOLD_BYTES = 2**30  # as much as the rest of a run takes


def first_step(scene: Scene, recipe: Recipe) -> JointOptimiser:
    """The optimisation at its first step, in the unit frame of the initial poses."""
    dataset, images, start, options = scene.dataset, scene.images, scene.start, recipe.options
    bodies = rigid_bodies(dataset, options)
    world_from_cam = bodies.held(start.world_from_cam, dataset.world_from_cam)
    numbers = recipe.method.scene
    depth = matched_depth(dataset, world_from_cam, scene.tracks, numbers)
    frame = scene_frame(world_from_cam, images, numbers, depth)
    poses = frame.unit_from_world.apply_to_poses(world_from_cam)
    excluded = scene.excluded_from_training
    adjusted = scene.tracks is not None and adjusts_cameras(dataset, recipe.method)
    by_photos = "none" if adjusted else options.refine_intrinsics
    lenses = lenses_of(
        dataset, images, by_photos, excluded, recipe.device, recipe.method.parameters, dollies=not bodies.tied
    )
    optimiser = JointOptimiser(images, frame, poses, recipe, excluded, pose_mobility(start), bodies, lenses)
    optimiser.camera_errors.doubt(start.guessed)
    return optimiser


def adjusts_cameras(dataset: Dataset, method: Method) -> bool:
    """Whether all cameras are adjusted at the end, and lenses with them where there are tracks.

    Published methods do not.
    """
    return method.adjustment and can_be_adjusted(len(dataset))


def memory_needed(scene: Scene, method: Method) -> str:
    """The end of a sentence on the memory that adjusting all cameras will take; empty where it is little.

    Raises:
        InputError: ``memory_too_small``: so much is not free.
    """
    if scene.tracks is None or not adjusts_cameras(scene.dataset, method):
        return ""
    free = free_memory()
    needed = adjustment_bytes(scene.tracks, len(scene.dataset), free)
    if free is not None and needed > free:
        raise InputError(
            "memory_too_small",
            f"Adjusting {len(scene.dataset)} cameras takes {needed / 2**30:.1f} GiB of memory, "
            f"and {free / 2**30:.1f} GiB are free.",
            hint="Use a machine with more memory; matches are kept. Or refine fewer photos, or parts of the set.",
        )
    return f"; adjusting all cameras takes up to {needed / 2**30:.1f} GiB" if needed > TOLD_BYTES else ""


def pose_mobility(start: InitialPoses) -> NDArray[np.float64]:
    """Each camera's factor of the pose rate [2, n] in stage 1 and stage 2.

    Cameras placed by matches keep still until the field has formed: an unformed field would carry them away.
    """
    return np.stack([np.where(start.matched, 0.0, 1.0), np.ones(len(start.matched))])


def stage_lengths(start: InitialPoses, asked: RefineOptions, recipe: Recipe) -> Recipe:
    """The recipe with shorter stages where matches placed most cameras, except those that were `asked` for."""
    adjusted = recipe.method.adjustment and can_be_adjusted(len(start.matched))
    if not (adjusted and start.mostly_matched and recipe.method.short_where_matched):
        return recipe
    return replace(recipe, options=matched_lengths(asked, recipe.options))
