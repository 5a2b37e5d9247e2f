"""Random pixels of photos, in Numba. The definition is `PhotoSampler.defined_draw`."""

from __future__ import annotations

import numpy as np

from biresnerf.field.numba_kernels import njit, prange


@njit(parallel=True, nogil=True, cache=True, error_model="numpy")
def draw_pixels(where, share, order, training, chances, sizes, offsets, pixels, image, xy, sharp, weight):
    """Fill image [rays], xy [rays, 2], sharp [rays, 3] and weight [rays] from random `where` [rays], `share` [rays, 2].

    `chances` are the arrays of `PixelChances`. Returns how many rays are of the first `training` views of `order`.
    """
    run, begin, ends, counted, first = chances
    rays, views, trained = len(where), len(order), 0
    each = np.float32(views / max(1, rays))
    for r in prange(rays):
        place = min(np.int64((np.float32(r) + where[r]) * each), views - 1)
        trained += place < training
        i = order[place]
        low, high, wanted = begin[i], begin[i + 1] - 1, i + np.float64(share[r, 0])
        while low < high:
            middle = (low + high) // 2
            if ends[middle] > wanted:
                high = middle
            else:
                low = middle + 1
        before = ends[low - 1] if low > begin[i] else np.float64(i)
        number = first[i + 1] - first[i]
        start = (low - begin[i]) * run
        inside = min(run, number - start)
        pixel = start + np.int64(share[r, 1] * np.float32(inside))
        if len(counted):
            pixel = np.int64(counted[first[i] + pixel])
        x, y = pixel % sizes[i, 0], pixel // sizes[i, 0]
        image[r], xy[r, 0], xy[r, 1] = i, np.float32(x) + np.float32(0.5), np.float32(y) + np.float32(0.5)
        weight[r] = inside / (number * (ends[low] - before))
        for c in range(3):
            sharp[r, c] = np.float32(pixels[offsets[i] + pixel, c]) / np.float32(255)
    return trained
