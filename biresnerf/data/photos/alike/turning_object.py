"""Whether photos, one after the other, seem to go once around an object, and whether what is behind it stands still."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from biresnerf.data.model.dataset import Dataset
from biresnerf.data.model.image_distances import Distances, distances_in_order, typical_distance
from biresnerf.data.model.image_order import natural_order
from biresnerf.data.photos.alike.image_likeness import thumbnails

TURNING = (
    "In the order of their names, the photos seem to go once around an object, as on a turntable: if features do not "
    "match, start=turntable finds their poses without."
)
IN_THE_WAY = "The background is the same in all photos and does not turn: mask it, or make it transparent."

LEAST_PHOTOS = 12
NEIGHBOUR_SHARE = 0.5  # neighbours differ by less than this share of what any two photos do
# A border pixel stands still if it varies by less than this over the photos, and most must; a border of one colour
# varies less than this from pixel to pixel, and turns or not without a trace. Of 1, the range of colours.
STILL, STILL_SHARE, PLAIN = 0.02, 0.75, 0.05


def goes_round(grey: NDArray[np.float32]) -> bool:
    """Whether photos, shrunk, in grey and in order [n, h, w], resemble their neighbours and the last one the first."""
    if len(grey) < LEAST_PHOTOS:
        return False
    apart, images = _differences(grey), len(grey)
    typical = float(np.median(distances_in_order(apart, images)))
    any_two = typical_distance(apart, images)
    first_to_last = float(apart(np.array([0]), np.array([images - 1]))[0, 0])
    return typical < NEIGHBOUR_SHARE * any_two and first_to_last < (typical + any_two) / 2


def _differences(grey: NDArray[np.float32]) -> Distances:
    """Root mean squared differences of photos [n, h, w]."""
    flat = grey.reshape(len(grey), -1).astype(np.float64)
    own = (flat**2).sum(1)

    def between(some: NDArray[np.int64], others: NDArray[np.int64]) -> NDArray[np.float64]:
        # By products: the differences themselves would take gigabytes for a thousand photos.
        squared = own[some, None] + own[others] - 2 * flat[some] @ flat[others].T
        return np.asarray(np.sqrt(np.maximum(squared, 0.0) / flat.shape[1]))

    return between


def still_surroundings(grey: NDArray[np.float32]) -> bool:
    """Whether the borders of all photos, shrunk and in grey [n, h, w], 0 to 1, show the same and not one colour."""
    border = np.concatenate((grey[:, 0], grey[:, -1], grey[:, :, 0], grey[:, :, -1]), 1)
    still = border.std(0) < STILL
    return bool(still.mean() >= STILL_SHARE) and float(border.mean(0)[still].std()) > PLAIN


def turning_notes(dataset: Dataset) -> tuple[str, ...]:
    """Notes for the user where photos without any pose seem to show something that turns.

    Raises `InputError` as `image_likeness.thumbnails` does.
    """
    if dataset.posed.any():
        return ()
    grey = thumbnails(dataset, natural_order(dataset.file_names)) / np.float32(255)
    if not goes_round(grey):
        return ()
    return (TURNING, IN_THE_WAY) if still_surroundings(grey) else (TURNING,)
