"""How far off rendered depth is, on scenes whose surfaces are known."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray

from biresnerf.data.model.dataset import Dataset
from biresnerf.data.synthetic.captures import PHONE_FROM_SCENE, TABLE_METRES, TABLE_SCENE, VASE
from biresnerf.data.synthetic.scene import MADE_SCENE, SHAPES, render_shapes
from biresnerf.data.synthetic.still_life import STILL_LIFE
from biresnerf.geometry.similarity import Similarity, align_robust
from biresnerf.refinement.optimise.renderer import Renderer
from biresnerf.refinement.scene.scene import Scene
from biresnerf.refinement.views.evaluation import render_view

_SAME = Similarity.identity()
_IN_METRES = Similarity(TABLE_METRES, PHONE_FROM_SCENE[:3, :3], np.zeros(3))
# By the name in the transforms file: the shapes, and where they lie in the world of the file's poses.
_MADE = {
    "dome": (SHAPES, _SAME),
    "still_life": (STILL_LIFE, _SAME),
    "vase": (VASE, _SAME),
    "table": (TABLE_SCENE, _IN_METRES),
}


def is_made(dataset: Dataset) -> bool:
    """Whether the set was rendered here, so that its `true_distance` is known."""
    return dataset.source.document.get(MADE_SCENE) in _MADE


def true_distance(
    dataset: Dataset, world_from_cam: NDArray[np.float64], width: int, height: int, focal: float
) -> NDArray[np.float64]:
    """Distance along the ray [height, width] to the nearest surface of a set that `is_made`; infinite where none is.

    In the world's unit, for a pinhole of ``focal`` px centred in the image, at a true pose [4, 4].
    """
    shapes, world_from_scene = _MADE[dataset.source.document[MADE_SCENE]]
    pose = world_from_scene.inverse().apply_to_poses(world_from_cam[None])[0]
    depth = render_shapes(shapes, (), pose, width, height, focal)[1].astype(np.float64)
    x = (np.arange(width) + 0.5 - width / 2) / focal
    y = (np.arange(height) + 0.5 - height / 2) / focal
    return world_from_scene.scale * depth * np.sqrt(1 + x**2 + y[:, None] ** 2)


def depth_error(scene: Scene, renderer: Renderer, truth: NDArray[np.float64]) -> float | None:
    """Mean absolute relative error of the depth rendered at the true poses of held-out views.

    Mean of |z - z*| / z* over the pixels that show a surface (Eigen et al. 2014), then over the views. None where none
    was held out, or only photos are known of the scene.

    Args:
        truth: world_from_cam [n, 4, 4]. A robust similarity carries it to the optimised poses.
    """
    if not scene.held_out or not is_made(scene.dataset):
        return None
    unit_from_true = align_robust(truth, renderer.joint.unit_from_cam)
    errors = []
    for image in scene.held_out:
        camera = scene.images.cameras[image]
        true = true_distance(scene.dataset, truth[image], camera.width, camera.height, camera.full().fx)
        matrix = torch.from_numpy(unit_from_true.apply_to_poses(truth[image][None])[0, :3])
        rendered = render_view(renderer, matrix, image).depth / unit_from_true.scale
        there = np.isfinite(true)
        errors.append(float((np.abs(rendered[there] - true[there]) / true[there]).mean()))
    return float(np.mean(errors))
