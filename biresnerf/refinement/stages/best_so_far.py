"""The best poses that a run has come to, kept while it goes on and in its checkpoints."""

from __future__ import annotations

from dataclasses import dataclass

from biresnerf.data.seeding.initial_poses import PoseArray
from biresnerf.report import Verdict


@dataclass(frozen=True, eq=False)
class BestSoFar:
    """Poses and lenses of one moment, and what was found of them. `verdict.so_far` chooses them.

    Attributes:
        unit_from_cam: float64 [n, 4, 4], in the optimisation's frame.
        increments: of the lenses, float64 [cameras, columns].
        verdict: on these poses.
        gain: the most that any poses were found to gain on the input's, log2 of the matches' error.
    """

    unit_from_cam: PoseArray
    increments: PoseArray
    verdict: Verdict
    gain: float
