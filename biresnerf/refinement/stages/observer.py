"""What others may see of a run on its way."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

from biresnerf.refinement.optimise.joint_optimiser import JointOptimiser

if TYPE_CHECKING:
    from biresnerf.refinement.stages.two_stages import TwoStages


@dataclass(frozen=True)
class Observer:
    """Looks into a run on its way; the run does not depend on what it sees.

    Attributes:
        at_check: what it returns at each check joins that check's line of the history.
        at_end: called once, when the poses are final.
        write_preview: shows the state of the run in files, and returns these relative to the output folder.
    """

    at_check: Callable[[JointOptimiser], dict[str, float]] = lambda _optimiser: {}
    at_end: Callable[[TwoStages], None] = lambda _stages: None
    write_preview: Callable[[TwoStages], tuple[str, ...]] = lambda _stages: ()
