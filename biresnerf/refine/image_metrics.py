"""PSNR and SSIM of images in [0, 1]."""

from __future__ import annotations

import math

import torch
from torch import Tensor

SSIM_WINDOW, SSIM_SIGMA = 11, 1.5
SSIM_C1, SSIM_C2 = 0.01**2, 0.03**2


def psnr(image: Tensor, reference: Tensor) -> float:
    """Peak signal-to-noise ratio in dB; identical images give 120."""
    error = float(((image.double() - reference.double()) ** 2).mean())
    return -10 * math.log10(max(error, 1e-12))


def ssim(image: Tensor, reference: Tensor) -> float:
    """Structural similarity (Wang et al. 2004) of [h, w, 3] images: Gaussian window of 11 px, sigma 1.5, mean over
    channels and over the pixels whose window lies inside; small images take the largest odd window that fits.
    """
    a, b = (x.double().permute(2, 0, 1)[:, None] for x in (image, reference))
    size = min(SSIM_WINDOW, *a.shape[2:])
    size -= 1 - size % 2
    offset = torch.arange(size, dtype=torch.float64) - size // 2
    window = torch.exp(-(offset**2) / (2 * SSIM_SIGMA**2))
    window = window / window.sum()

    def blurred(x: Tensor) -> Tensor:
        x = torch.nn.functional.conv2d(x, window.reshape(1, 1, 1, -1))
        return torch.nn.functional.conv2d(x, window.reshape(1, 1, -1, 1))

    mean_a, mean_b = blurred(a), blurred(b)
    variance_a = blurred(a * a) - mean_a**2
    variance_b = blurred(b * b) - mean_b**2
    covariance = blurred(a * b) - mean_a * mean_b
    luminance = (2 * mean_a * mean_b + SSIM_C1) / (mean_a**2 + mean_b**2 + SSIM_C1)
    structure = (2 * covariance + SSIM_C2) / (variance_a + variance_b + SSIM_C2)
    return float((luminance * structure).mean())
