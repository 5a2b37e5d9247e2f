"""Batches of rays in Numba: random pixels, and errors by camera.

The definitions are `PhotoSampler.defined_draw` and `CameraErrors.defined_add`.
"""

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


@njit(nogil=True, cache=True, error_model="numpy")
def add_errors(image, colour, target, opacity, weight, sums):
    """Add rays, squared errors and opacities of images `image` [rays], times `weight` [rays], to `sums` [n, 3].

    `colour` and `target` are [rays, 3], `opacity` [rays].
    """
    third = np.float32(1 / 3)
    for r in range(len(image)):
        squared = np.float32(0)
        for c in range(3):
            off = colour[r, c] - target[r, c]
            squared += off * off
        row, w = sums[image[r]], weight[r]
        row[0] += w
        row[1] += squared * third * w
        row[2] += opacity[r] * w
