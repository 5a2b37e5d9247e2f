"""Compare two sets of poses by figures measured on the same views, cameras or matches; and all rules.

docs/verdict.md says which decision uses which rule.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from biresnerf.arrays import Array
from biresnerf.report import Finding, PairedDifference

# Student's t, two-sided at 95 %, for 1 to 30 degrees of freedom; from there on 1.96 + 2.5 / degrees is near enough.
STUDENT = (
    12.706, 4.303, 3.182, 2.776, 2.571, 2.447, 2.365, 2.306, 2.262, 2.228, 2.201, 2.179, 2.160, 2.145, 2.131,
    2.120, 2.110, 2.101, 2.093, 2.086, 2.080, 2.074, 2.069, 2.064, 2.060, 2.056, 2.052, 2.048, 2.045, 2.042,
)  # fmt: skip
SAME_WITHIN = 1.5  # times what matters: an interval inside it means no difference


@dataclass(frozen=True)
class Rule:
    """How large and how certain a mean gain must be for one set of poses to be better.

    Attributes:
        least: the gain that matters, in the figure's unit.
        errors: half the interval, in standard errors; None: Student's at 95 %; 0: chance is ignored, one gain suffices.
        fewest: gains that are needed for a finding.
        beyond: the whole interval lies above it, in the figure's unit.
    """

    least: float = 0.0
    errors: float | None = None
    fewest: int = 1
    beyond: float = 0.0


# Views that no field was trained on, dB and SSIM: trainings on the same poses differ by less, and poses that were
# fitted to small photos predict these up to 0.4 dB better than the true ones do (docs/verdict.md).
UNSEEN_PSNR, UNSEEN_SSIM = Rule(least=0.5), Rule(least=0.01)
# Errors of feature matches by photo, in octaves: 7 %. Means of such gains over the input's poses, one after the other.
MATCH_ERRORS = Rule(least=0.1)
LATER_MATCH_ERRORS = Rule(least=0.1, errors=0)
# Feature matches that miss by more than this share of the image fit no scene: neither set of poses can be trusted.
FITS_BELOW = 0.02
# Misfits to evidence that was left out, in octaves by camera: candidates are near each other, so any gain counts.
# Evidence that knows fewer cameras with both sets of poses says nothing of them.
LEFT_OUT = Rule(fewest=3)
# The same in squared noise levels, by point: whether another parameter of lenses pays.
FREER_LENS = Rule(errors=2.0)
# Noise levels of measured places, in standard deviations of such a level.
MEASURED = Rule(least=3.0, errors=0)
# A short trial of whole sets, dB over all unseen views: less is a tie.
TRIAL = Rule(least=0.3, errors=0)
# A set of poses that is right is better by more than this: 2.4 to 8 dB over noisy ones on ten sets, 1.6 on kitchen25.
# One that is consistent but wrong is not: 0.2 and 1.2 dB on coffee, a symmetric thing.
CLEAR_TRIAL = Rule(least=2.0, errors=0)
# Unseen photos must be predicted this much better than by a mean of photos that resemble them: at 100 px, after 600 to
# 800 steps with a guessed lens, lund_door +4.3 dB, fern +1.2 dB; cameras around a scene, temple -1.6 dB, lego +0.9 dB.
# Where a background is known, it alone makes some of the difference.
FACING_FORWARD, FACING_FORWARD_BOUNDED = Rule(least=1.0, errors=0), Rule(least=2.0, errors=0)
# Photos that one of two results confirms and the other does not, +1 or -1; 0 for all others.
PHOTOS_CONFIRMED = Rule()
# Bounds that two results state of one pose, in octaves. On five sets they missed true errors by up to 2.5 times
# (docs/estimator.md, Uncertainty), so that less than a factor of two shows nothing.
STATED_ACCURACY = Rule(least=1.0)
ANY_GAIN = Rule(errors=0)  # of one camera's own matches, or over a guess
# One camera's error in a frozen field, in octaves: below 0.7 of the old one, and below a quarter where it is still
# larger than the others' (docs/studies.md).
REPAIRED, FAR_REPAIRED = Rule(least=-math.log2(0.7), errors=0), Rule(least=2.0, errors=0)
# Readings of given poses, shares of what photos have in common that agree. On 15 real sets with noise of 0 to 0.3, two
# seeds each, no wrong reading was more than 2.1 standard errors better than the right one. Readings that are behind the
# best by no more than one are as good.
READING = Rule(least=0.1, errors=4.0)
BEHIND = Rule(least=1e-9, errors=1.0)


class Compared(NamedTuple):
    """The mean gain, its interval (None for too few gains) and the finding."""

    mean: float
    low: float | None
    high: float | None
    finding: Finding


def compare(gains: Array | float, rule: Rule) -> Compared:
    """What gains [n] say about a set of poses: positive ones support it, whatever the figure."""
    each = np.atleast_1d(gains)
    count, mean = len(each), float(each.mean()) if np.size(each) else math.nan
    if count < max(rule.fewest, 1 if rule.errors == 0 else 2):
        return Compared(mean, None, None, "open")
    half = 0.0
    if rule.errors != 0:
        errors = student_quantile(count - 1) if rule.errors is None else rule.errors
        half = errors * float(each.std(ddof=1)) / count**0.5
    low, high = mean - half, mean + half
    finding: Finding = "open"
    if low > rule.beyond and mean >= rule.least:
        finding = "better"
    elif high < -rule.beyond and mean <= -rule.least:
        finding = "worse"
    elif max(-low, high) <= SAME_WITHIN * rule.least:
        finding = "same"
    return Compared(mean, low, high, finding)


def is_better(gains: Array | float, rule: Rule) -> bool:
    """Whether gains [n] support a set of poses."""
    return compare(gains, rule).finding == "better"


def paired(before: Array, after: Array, rule: Rule, gains: Array | None = None) -> PairedDifference:
    """The comparison of a figure [n], for a report; by its `gains` [n] where larger is not better."""
    mean, low, high, finding = compare(after - before if gains is None else gains, rule)
    return PairedDifference(
        count=len(before), before=float(before.mean()), after=float(after.mean()),
        difference=mean, low=low, high=high, finding=finding,
    )  # fmt: skip


def octaves(before: Array | float, after: Array | float, least: float) -> Array:
    """How often errors were halved: log2 of before over after. Those below the least are equal."""
    return np.asarray(np.log2(np.maximum(before, least) / np.maximum(after, least)))


def student_quantile(freedom: int) -> float:
    """Half the width of a 95 % interval, in standard errors, with so many degrees of freedom."""
    return STUDENT[freedom - 1] if freedom <= len(STUDENT) else 1.96 + 2.5 / freedom
