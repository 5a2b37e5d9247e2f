"""What models of one set say of each other and of the lenses."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from biresnerf.data.model.dataset import Dataset
from biresnerf.data.seeding.map_images import MappedModel, known_intrinsics
from biresnerf.geometry.camera.lens import lens_problem
from biresnerf.geometry.pose_error import rotation_between_deg
from biresnerf.geometry.similarity import align_robust

SAME_DEG = 2.0  # models whose cameras differ by less (median) say the same


def adds_to(best: MappedModel, other: MappedModel) -> bool:
    """Whether a model has other images than the best one, or other rotations, seen through the same lenses."""
    if not _same_lenses(best, other):
        return False
    shared, at, there = np.intersect1d(best.rows, other.rows, return_indices=True)
    if len(shared) < len(other.rows):
        return True
    poses = best.world_from_cam[at]
    carried = align_robust(other.world_from_cam[there], poses, with_rotations=True).apply_to_poses(
        other.world_from_cam[there]
    )
    turned = rotation_between_deg(poses, carried)
    return float(np.median(turned)) >= SAME_DEG


def _same_lenses(one: MappedModel, other: MappedModel) -> bool:
    return all(
        i in one.cameras and np.allclose(one.cameras[i].params, camera.params, rtol=1e-3, atol=1e-3)
        for i, camera in other.cameras.items()
    )


def model_lens_problem(dataset: Dataset, model: MappedModel) -> str | None:
    """An impossible lens is what COLMAP finds where the views fix too little."""
    known = known_intrinsics(dataset)
    for i, camera in model.cameras.items():
        problem = None if known[i] else lens_problem(camera.full(), camera.width, camera.height)
        if problem is not None:
            return problem
    return None


def with_found_lenses(dataset: Dataset, models: list[MappedModel]) -> Dataset:
    """The first model's lenses in place of guessed ones."""
    known = known_intrinsics(dataset)
    if not models or all(known):
        return dataset
    cameras, sources = list(dataset.cameras), list(dataset.intrinsics_sources)
    for i, camera in models[0].cameras.items():
        if not known[i]:
            cameras[i], sources[i] = camera, "colmap"
    return replace(dataset, cameras=tuple(cameras), intrinsics_sources=tuple(sources))
