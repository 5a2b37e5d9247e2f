"""Sets that turn before the camera: where their cameras begin, and what is said of photos that look like that."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray

from biresnerf.data.model.dataset import Dataset
from biresnerf.data.model.image_order import natural_order
from biresnerf.data.photos.image_likeness import thumbnails
from biresnerf.data.photos.turning_object import goes_round, still_surroundings
from biresnerf.data.seeding.initial_poses import InitialPoses
from biresnerf.geometry.turntable import Ring
from biresnerf.report import PoseSource

TURNING = (
    "In the order of their names, the photos seem to go once around an object, as on a turntable: if features do not "
    "match, start=turntable finds their poses without."
)
STILL = "The background is the same in all photos and does not turn with the object: mask it, or make it transparent."


def even_ring(dataset: Dataset) -> InitialPoses:
    """All images evenly on a level ring about the z axis, in the order of their names."""
    name: PoseSource = "turntable"
    count = len(dataset)
    azimuth = torch.empty(count, dtype=torch.float64)
    azimuth[natural_order(dataset.file_names)] = torch.arange(count).double() * (2 * torch.pi / count)
    return InitialPoses(Ring.level(azimuth).matrices(), name, (name,) * count)


def turning_notes(dataset: Dataset) -> tuple[str, ...]:
    """What to tell the user where photos without any pose seem to show something that turns.

    Raises `InputError` as `image_likeness.thumbnails` does.
    """
    if dataset.posed.any():
        return ()
    return notes_on(thumbnails(dataset, natural_order(dataset.file_names)) / np.float32(255))


def notes_on(grey: NDArray[np.float32]) -> tuple[str, ...]:
    """`turning_notes` of photos in order, shrunk and in grey [n, h, w], 0 to 1."""
    if not goes_round(grey):
        return ()
    return (TURNING, STILL) if still_surroundings(grey) else (TURNING,)
