"""Pictures sampled between their pixels, for photos seen through another lens."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


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
