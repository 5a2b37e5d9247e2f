"""PSNR and SSIM of images in [0, 1], and what a PSNR is worth in px."""

from __future__ import annotations

import math

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

SSIM_WINDOW, SSIM_SIGMA = 11, 1.5
SSIM_C1, SSIM_C2 = 0.01**2, 0.03**2
SHIFTS = (1, 2, 3, 4, 6, 8, 12, 16)  # px


def psnr(image: Tensor, reference: Tensor, counts: Tensor | None = None) -> float:
    """Peak signal-to-noise ratio in dB over the pixels that `counts` [h, w] names, all if left out.

    Identical images give 120.
    """
    squared = (image.double() - reference.double()) ** 2
    error = float((squared if counts is None else squared[counts]).mean())
    return -10 * math.log10(max(error, 1e-12))


def ssim(image: Tensor, reference: Tensor, counts: Tensor | None = None) -> float:
    """Structural similarity (Wang et al. 2004) of [h, w, 3] images.

    Gaussian window of 11 px, sigma 1.5, mean over channels and over the pixels whose window lies inside; small images
    take the largest odd window that fits.

    Pixels that `counts` [h, w] leaves out have no part in it: windows weigh what is left of them, and the mean is over
    pixels that count (over all, where none has its window inside).
    """
    a, b = (x.double().permute(2, 0, 1)[:, None] for x in (image, reference))
    size = min(SSIM_WINDOW, *a.shape[2:])
    size -= 1 - size % 2
    offset = torch.arange(size, dtype=torch.float64) - size // 2
    window = torch.exp(-(offset**2) / (2 * SSIM_SIGMA**2))
    window = window / window.sum()
    weight = torch.ones_like(a[:1]) if counts is None else counts.double()[None, None]

    def summed(x: Tensor) -> Tensor:
        x = torch.nn.functional.conv2d(x, window.reshape(1, 1, 1, -1))
        return torch.nn.functional.conv2d(x, window.reshape(1, 1, -1, 1))

    weights = summed(weight)

    def blurred(x: Tensor) -> Tensor:
        return summed(x * weight) / weights.clamp(min=1e-12)

    mean_a, mean_b = blurred(a), blurred(b)
    variance_a = blurred(a * a) - mean_a**2
    variance_b = blurred(b * b) - mean_b**2
    covariance = blurred(a * b) - mean_a * mean_b
    luminance = (2 * mean_a * mean_b + SSIM_C1) / (mean_a**2 + mean_b**2 + SSIM_C1)
    structure = (2 * covariance + SSIM_C2) / (variance_a + variance_b + SSIM_C2)
    half = size // 2
    inner = weight[..., half : weight.shape[2] - half, half : weight.shape[3] - half].expand_as(luminance)
    if not bool(inner.any()):
        inner = torch.ones_like(inner)
    return float((luminance * structure * inner).sum() / inner.sum())


def shift_px(error_db: float, photo: NDArray[np.float32], counts: NDArray[np.bool_] | None = None) -> float:
    """The shift (px) at which a photo [h, w, 3] differs from itself by such a PSNR: `SHIFTS[-1]` at most.

    It puts an error of colours in terms of a motion in the image. The blur of a render counts as well, so that a motion
    is overrated rather than underrated.
    """
    shifts = [shift for shift in SHIFTS if 2 * shift < min(photo.shape[:2])]
    errors = [_error_shifted(photo, shift, counts) ** 0.5 for shift in shifts]
    # Of a pattern that repeats, or beyond the size of things, photos shifted further may differ less.
    return float(np.interp(10 ** (-error_db / 20), np.maximum.accumulate([0.0, *errors]), [0, *shifts]))


def _error_shifted(photo: NDArray[np.float32], shift: int, counts: NDArray[np.bool_] | None) -> float:
    """Mean squared difference from itself, shifted along the rows and along the columns."""
    errors = []
    for axis in (0, 1):
        one, other = (np.arange(photo.shape[axis] - shift) + start for start in (0, shift))
        squared = (photo.take(one, axis) - photo.take(other, axis)) ** 2
        if counts is not None:
            squared = squared[counts.take(one, axis) & counts.take(other, axis)]
        errors.append(float(squared.mean()) if squared.size else 0.0)
    return float(np.mean(errors))
