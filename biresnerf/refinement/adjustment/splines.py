"""Photos as cubic B-splines: smooth, with exact gradients."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float32]

POLE = 3**0.5 - 2  # of the filter that turns pixels into coefficients (Unser 1999)
REACH = 3.0  # a Gaussian is cut off after so many standard deviations


def spline_coefficients(photo: Floats) -> Floats:
    """Coefficients [h, w, c] of the cubic B-spline through the pixels [h, w, c], mirrored at the borders."""
    return _filtered(_filtered(photo).swapaxes(0, 1)).swapaxes(0, 1)


def _filtered(values: Floats) -> Floats:
    """Filter along the first axis."""
    n = len(values)
    if n == 1:
        return values
    reach = min(n, 16)  # beyond, the pole's powers are rounding errors
    powers = (POLE ** np.arange(reach)).astype(np.float32)
    out = np.array(values, dtype=np.float32)
    out[0] = np.tensordot(powers, values[:reach], 1)
    for k in range(1, n):
        out[k] += np.float32(POLE) * out[k - 1]
    out[-1] = np.float32(POLE / (POLE * POLE - 1)) * (out[-1] + np.float32(POLE) * out[-2])
    for k in range(n - 2, -1, -1):
        out[k] = np.float32(POLE) * (out[k + 1] - out[k])
    return np.asarray(out * np.float32(6.0))


def blurred(photo: Floats, sigma_px: float) -> Floats:
    """Blur by a Gaussian over the first two axes, mirrored at the borders."""
    if sigma_px <= 0:
        return photo
    half = int(np.ceil(REACH * sigma_px))
    weights = np.exp(-0.5 * (np.arange(-half, half + 1) / sigma_px) ** 2)
    weights = (weights / weights.sum()).astype(np.float32)
    for axis in (0, 1):
        width = [(half, half) if a == axis else (0, 0) for a in range(photo.ndim)]
        padded = np.pad(photo, width, mode="symmetric")
        n = photo.shape[axis]
        photo = sum(w * padded.take(range(k, k + n), axis) for k, w in enumerate(weights))
    return photo
