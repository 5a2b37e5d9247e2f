"""Paired comparisons of two sets of poses: over the same views or cameras, with Student's interval."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from biresnerf.report import Finding, PairedDifference

Array = NDArray[np.float64]

# Student's t, two-sided at 95 %, for 1 to 30 degrees of freedom; from there on 1.96 + 2.5 / degrees is near enough.
STUDENT = (
    12.706, 4.303, 3.182, 2.776, 2.571, 2.447, 2.365, 2.306, 2.262, 2.228, 2.201, 2.179, 2.160, 2.145, 2.131,
    2.120, 2.110, 2.101, 2.093, 2.086, 2.080, 2.074, 2.069, 2.064, 2.060, 2.056, 2.052, 2.048, 2.045, 2.042,
)  # fmt: skip
# Differences that matter: of unseen views in dB and in SSIM, of matching errors in log2 (7 % of the error).
PSNR_MATTERS, SSIM_MATTERS, EPIPOLAR_MATTERS = 0.5, 0.01, 0.1
# Feature matches that miss by more than this share of the image fit no scene: neither set of poses can be trusted.
FITS_BELOW = 0.02
SAME_WITHIN = 1.5  # times what matters: an interval inside it means no difference


def paired(before: Array, after: Array, matters: float, gains: Array | None = None) -> PairedDifference:
    """The comparison of a figure [n] of which more is better, or else by its `gains` [n], positive where better."""
    gains = after - before if gains is None else gains
    mean, count = float(gains.mean()), len(gains)
    low = high = None
    if count > 1:
        half = student_quantile(count - 1) * float(gains.std(ddof=1)) / count**0.5
        low, high = mean - half, mean + half
    return PairedDifference(
        count=count, before=float(before.mean()), after=float(after.mean()), difference=mean, low=low, high=high,
        finding=finding(mean, low, high, matters),
    )  # fmt: skip


def student_quantile(freedom: int) -> float:
    """Half the width of a 95 % interval, in standard errors, with so many degrees of freedom."""
    return STUDENT[freedom - 1] if freedom <= len(STUDENT) else 1.96 + 2.5 / freedom


def finding(mean: float, low: float | None, high: float | None, matters: float) -> Finding:
    """What a difference and its interval say, given the least difference that matters."""
    if low is None or high is None:
        return "open"
    if low > 0 and mean >= matters:
        return "better"
    if high < 0 and mean <= -matters:
        return "worse"
    return "same" if max(-low, high) <= SAME_WITHIN * matters else "open"
