"""The way back from the unit frame: optimised poses in the frame and scale of the input's."""

from __future__ import annotations

import numpy as np

from biresnerf.data.model.dataset import Dataset
from biresnerf.geometry.similarity import Similarity, align_by_spread, align_robust
from biresnerf.refine.optimise.joint_optimiser import JointOptimiser


def poses_in_input_frame(dataset: Dataset, optimiser: JointOptimiser) -> tuple[np.ndarray, Similarity]:
    """Refined world_from_cam [n, 4, 4] carried into the input's frame, and the similarity that does it.

    The optimisation leaves frame and scale free; what ties them down is the best similarity, robust to lost
    cameras unless the method has it otherwise, from the optimised poses to the given ones. Fixed cameras and rigs
    leave less open.
    """
    world_from_unit = optimiser.frame.unit_from_world.inverse()
    optimised = world_from_unit.apply_to_poses(optimiser.poses.poses().numpy())
    given, tied = dataset.world_from_cam, dataset.anchors
    input_from_optimised = optimiser.bodies.input_from_optimised(optimised, given)
    if input_from_optimised is None and optimiser.method.robust_frame:
        input_from_optimised = align_robust(optimised[tied], given[tied], with_rotations=True)
    elif input_from_optimised is None:
        input_from_optimised = align_by_spread(optimised[tied], given[tied])
    carried = input_from_optimised.apply_to_poses(optimised)
    return optimiser.bodies.restored(carried, given), input_from_optimised
