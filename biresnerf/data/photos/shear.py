"""Photos of cameras with skew, straightened once: their rows are moved as `Camera.shear` says.

No camera model of COLMAP, nerfstudio or instant-ngp has skew, so it is taken out of the pixels. Poses do not change.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from biresnerf.data.photos.bilinear import resampled
from biresnerf.geometry.camera.camera_models import Camera


def straightened(picture: NDArray[np.uint8], shear: float) -> NDArray[np.uint8]:
    """The picture [h, w, channels] with its rows moved; outside, the border's pixels go on."""
    if not shear:
        return picture
    height, width = picture.shape[:2]
    return resampled(picture, width, height, lambda at: _stored(at, shear, height))


def straightened_mask(counts: NDArray[np.bool_], shear: float) -> NDArray[np.bool_]:
    """Which pixels count, bool [h, w], of a picture whose rows are moved: none with a pixel from outside."""
    if not shear:
        return counts
    height, width = counts.shape
    y, x = np.mgrid[0:height, 0:width] + 0.5
    source = _stored(np.stack([x.ravel(), y.ravel()], axis=1), shear, height)[:, 0].reshape(height, width)
    whole = straightened(np.where(counts, 255, 0).astype(np.uint8)[..., None], shear)[..., 0] == 255
    return np.asarray(whole & (source >= 0.5) & (source <= width - 0.5))


def _stored(at: NDArray[np.float64], shear: float, height: int) -> NDArray[np.float64]:
    """Where positions [m, 2] in the straightened picture are in the stored one."""
    return np.column_stack([at[:, 0] + shear * (at[:, 1] - height / 2), at[:, 1]])


def shear_notes(cameras: Sequence[Camera]) -> list[str]:
    """A note on the photos' cameras that have skew, if any."""
    moved = [abs(camera.shear) * camera.height / 2 for camera in cameras if camera.shear]
    if not moved:
        return []
    return [
        f"{len(moved)} photos were taken with skew, which no camera model of the result has. They are straightened "
        f"first, by up to {max(moved):.2g} px at the edges: cameras in the result are those of the straightened "
        "photos, which its format pinhole contains"
    ]
