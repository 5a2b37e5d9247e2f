"""Random pixels of photos, in Numba. The definition is `PhotoSampler._drawn`."""

from __future__ import annotations

import numpy as np
from numba import njit


@njit(nogil=True, cache=True, error_model="numpy")
def draw_pixels(where, share, order, training, sizes, offsets, pixels, image, xy, sharp):
    """Fill image [rays], xy [rays, 2] and sharp [rays, 3] from the random numbers `where` [rays] and `share` [rays, 2].

    Returns how many rays are of the first `training` views of `order`.
    """
    rays, views, trained = len(where), len(order), 0
    each = np.float32(views / max(1, rays))
    for r in range(rays):
        place = min(np.int64((np.float32(r) + where[r]) * each), views - 1)
        trained += place < training
        i = order[place]
        x, y = (
            np.floor(share[r, 0] * np.float32(sizes[i, 0])),
            np.floor(share[r, 1] * np.float32(sizes[i, 1])),
        )
        image[r], xy[r, 0], xy[r, 1] = i, x + np.float32(0.5), y + np.float32(0.5)
        at = offsets[i] + np.int64(y) * sizes[i, 0] + np.int64(x)
        for c in range(3):
            sharp[r, c] = np.float32(pixels[at, c]) / np.float32(255)
    return trained
