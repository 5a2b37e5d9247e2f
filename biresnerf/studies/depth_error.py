"""How far off rendered depth is, on scenes whose surfaces are known."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray

from biresnerf.data.synthetic.true_depth import is_made, true_distance
from biresnerf.geometry.similarity import align_robust
from biresnerf.refinement.optimise.joint_optimiser import JointOptimiser
from biresnerf.refinement.scene.scene import Scene
from biresnerf.refinement.views.evaluation import render_view


def depth_error(optimiser: JointOptimiser, scene: Scene, truth: NDArray[np.float64]) -> float | None:
    """Mean absolute relative error of the depth rendered at the true poses of held-out views.

    Mean of |z - z*| / z* over the pixels that show a surface (Eigen et al. 2014), then over the views. None where none
    was held out, or only photos are known of the scene.

    Args:
        truth: world_from_cam [n, 4, 4]. A robust similarity carries it to the optimised poses.
    """
    if not scene.held_out or not is_made(scene.dataset):
        return None
    unit_from_true = align_robust(truth, optimiser.poses.poses().numpy())
    errors = []
    for image in scene.held_out:
        camera = scene.images.cameras[image]
        true = true_distance(scene.dataset, truth[image], camera.width, camera.height, camera.full().fx)
        matrix = torch.from_numpy(unit_from_true.apply_to_poses(truth[image][None])[0, :3])
        rendered = render_view(optimiser, matrix, image).depth / unit_from_true.scale
        there = np.isfinite(true)
        errors.append(float((np.abs(rendered[there] - true[there]) / true[there]).mean()))
    return float(np.mean(errors))
