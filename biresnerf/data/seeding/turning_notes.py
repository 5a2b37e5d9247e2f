"""What is said of photos that seem to show something that turns before the camera. Loads no torch."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from biresnerf.data.model.dataset import Dataset
from biresnerf.data.model.image_order import natural_order
from biresnerf.data.photos.image_likeness import thumbnails
from biresnerf.data.photos.turning_object import goes_round, still_surroundings

TURNING = (
    "In the order of their names, the photos seem to go once around an object, as on a turntable: if features do not "
    "match, start=turntable finds their poses without."
)
STILL = "The background is the same in all photos and does not turn with the object: mask it, or make it transparent."


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
