"""The errors of a batch, summed by camera, in Numba. The definition is `CameraErrors.defined_add`."""

from __future__ import annotations

import numpy as np

from biresnerf.field.numba_kernels import njit


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
