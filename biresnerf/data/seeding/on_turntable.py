"""Where the cameras of a set begin that turns before the camera."""

from __future__ import annotations

import numpy as np

from biresnerf.data.model.dataset import Dataset
from biresnerf.data.model.image_order import natural_order
from biresnerf.data.seeding.initial_poses import InitialPoses
from biresnerf.geometry.level_ring import level_ring
from biresnerf.report import PoseSource


def even_ring(dataset: Dataset) -> InitialPoses:
    """All images evenly on a level ring about the z axis, in the order of their names."""
    name: PoseSource = "turntable"
    count = len(dataset)
    azimuth = np.empty(count)
    azimuth[natural_order(dataset.file_names)] = np.arange(count) * (2 * np.pi / count)
    return InitialPoses(level_ring(azimuth), name, (name,) * count)
