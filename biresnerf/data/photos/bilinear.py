"""Pictures sampled between their pixels, for photos seen through another lens."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

_ROWS_AT_ONCE = 256


def bilinear(values: NDArray[np.float32], at: NDArray[np.float64]) -> NDArray[np.float32]:
    """Samples [m, channels] of a picture [h, w, channels] at positions [m, 2] in pixel indices.

    Outside the picture its border pixels go on.
    """
    height, width = values.shape[:2]
    x, y = np.clip(at[:, 0], 0, width - 1), np.clip(at[:, 1], 0, height - 1)
    left, top = np.minimum(x.astype(np.int64), width - 2), np.minimum(y.astype(np.int64), height - 2)
    left, top = np.maximum(left, 0), np.maximum(top, 0)
    right, below = np.minimum(left + 1, width - 1), np.minimum(top + 1, height - 1)
    a, b = (x - left).astype(np.float32)[:, None], (y - top).astype(np.float32)[:, None]
    upper = values[top, left] * (1 - a) + values[top, right] * a
    lower = values[below, left] * (1 - a) + values[below, right] * a
    return upper * (1 - b) + lower * b


def resampled(
    picture: NDArray[np.uint8],
    width: int,
    height: int,
    source_of: Callable[[NDArray[np.float64]], NDArray[np.float64]],
) -> NDArray[np.uint8]:
    """The picture [h, w, channels] at another size, each pixel from where ``source_of`` says; bilinear.

    Colours of a picture with opacity are weighed by it.

    Args:
        source_of: positions [m, 2] in ``picture`` (px, first pixel at (0.5, 0.5)) of positions [m, 2] in the result.
    """
    values = picture.astype(np.float32)
    opacity = values.shape[2] == 4
    if opacity:
        values[..., :3] *= values[..., 3:] / 255.0
    made = np.empty((height, width, values.shape[2]), dtype=np.uint8)
    for first in range(0, height, _ROWS_AT_ONCE):
        last = min(first + _ROWS_AT_ONCE, height)
        y, x = np.mgrid[first:last, 0:width] + 0.5
        rows = bilinear(values, source_of(np.stack([x.ravel(), y.ravel()], axis=1)) - 0.5)
        if opacity:
            rows[:, :3] *= 255.0 / np.maximum(rows[:, 3:], 1e-3)
        shape = (last - first, width, values.shape[2])
        made[first:last] = np.clip(np.rint(rows), 0, 255).astype(np.uint8).reshape(shape)
    return made
