"""Where the cameras of a set begin that turns before the camera."""

from __future__ import annotations

import torch

from biresnerf.data.model.dataset import Dataset
from biresnerf.data.model.image_order import natural_order
from biresnerf.data.seeding.initial_poses import InitialPoses
from biresnerf.geometry.turntable import Ring
from biresnerf.report import PoseSource


def even_ring(dataset: Dataset) -> InitialPoses:
    """All images evenly on a level ring about the z axis, in the order of their names."""
    name: PoseSource = "turntable"
    count = len(dataset)
    azimuth = torch.empty(count, dtype=torch.float64)
    azimuth[natural_order(dataset.file_names)] = torch.arange(count).double() * (2 * torch.pi / count)
    return InitialPoses(Ring.level(azimuth).matrices(), name, (name,) * count)
