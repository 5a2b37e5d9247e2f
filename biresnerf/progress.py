"""Progress as data: what the pipeline reports to its caller. No torch, no text formatting."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from pydantic import Field

from biresnerf.errors import Interrupted
from biresnerf.frozen_model import FrozenModel
from biresnerf.options.refine_options import ResolvedOptions
from biresnerf.stages import ReusableStage, Stage

# Where the parts of a run begin, as fractions of the whole.
KERNELS_FROM, SEEDING_FROM, TRYING_FROM, START_KNOWN = 0.005, 0.01, 0.016, 0.02
STAGES_FROM, EXPORTING_FROM = 0.03, 0.99


class Progress(FrozenModel):
    """One report of progress. ``fraction`` never falls within one run."""

    stage: Stage
    step: int = Field(0, ge=0)
    steps_total: int = Field(0, ge=0)
    fraction: float = Field(0.0, ge=0.0, le=1.0)
    eta_s: float | None = Field(None, ge=0.0, description="Estimated seconds to the end of the run.")
    metrics: dict[str, float] = Field(default_factory=dict)
    message: str = ""
    options: ResolvedOptions | None = Field(
        None,
        description="Options as the run uses them; reported once they are known, and again if they change.",
    )
    checkpoint: str | None = Field(
        None, description="File name of a checkpoint just completed, relative to the output folder."
    )
    preview: tuple[str, ...] = Field(
        (), description="Files just written that show how far the run is, relative to the output folder."
    )
    reusable: dict[ReusableStage, tuple[str, ...]] = Field(
        default_factory=dict,
        description="Files just completed that another run can start from, by the stage whose work they hold.",
    )


OnProgress = Callable[[Progress], None]


@dataclass(frozen=True)
class Monitor:
    """Whoever follows a run.

    Attributes:
        report: called with each `Progress`.
        should_stop: asked after every step, view, frame and photo; once true, the run ends with `Interrupted`.
    """

    report: OnProgress = lambda _progress: None
    should_stop: Callable[[], bool] = lambda: False

    def raise_if_stopped(self, message: str) -> None:
        """Raise `Interrupted` with ``message`` if the run is to stop."""
        if self.should_stop():
            raise Interrupted(message)
