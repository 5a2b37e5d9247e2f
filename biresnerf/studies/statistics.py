"""Is one variant better than another over all scenes and seeds? Wilcoxon's signed-rank test on paired results."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from pydantic import BaseModel, ConfigDict, Field


class PairedTest(BaseModel):
    """A two-sided Wilcoxon signed-rank test of ``other - first``."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    pairs: int = Field(description="n: scenes x starts x seeds that both variants finished.")
    differing: int = Field(description="Pairs that differ; the test leaves the others out.")
    statistic: float | None = Field(
        description="The smaller of the two rank sums; None without a difference."
    )
    p_value: float | None
    median_difference: float = Field(description="Median of other - first.")


def paired_wilcoxon(first: Sequence[float], other: Sequence[float]) -> PairedTest | None:
    """Test pairs of results of two variants, in the same order; None where there are none.

    The test is exact for up to 50 differing pairs without ties, as scipy decides.
    """
    from scipy.stats import wilcoxon

    difference = np.asarray(other, dtype=np.float64) - np.asarray(first, dtype=np.float64)
    if not len(difference):
        return None
    differing = int(np.count_nonzero(difference))
    statistic = p_value = None
    if differing:
        tested = wilcoxon(difference, zero_method="wilcox", alternative="two-sided")
        statistic, p_value = float(tested.statistic), float(tested.pvalue)
    return PairedTest(
        pairs=len(difference),
        differing=differing,
        statistic=statistic,
        p_value=p_value,
        median_difference=float(np.median(difference)),
    )
