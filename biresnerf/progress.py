"""Progress as data: what the pipeline reports to its caller. No torch, no text formatting."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

from pydantic import Field

from biresnerf.errors import Interrupted
from biresnerf.forecast.run_forecast import Forecast
from biresnerf.frozen_model import FrozenModel
from biresnerf.options.refine_options import ResolvedOptions
from biresnerf.stages import ReusableStage, Stage


class Progress(FrozenModel):
    """One report of progress. ``fraction`` never falls within one run."""

    stage: Stage
    step: int = Field(0, ge=0)
    steps_total: int = Field(0, ge=0)
    fraction: float = Field(0.0, ge=0.0, le=1.0)
    eta_s: float | None = Field(None, ge=0.0, description="Estimated seconds to the end of the run.")
    metrics: dict[str, float] = Field(
        default_factory=dict,
        description="With ``machine_busy``: 1 while other programs take much of the processor, otherwise 0.",
    )
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


def told_before_the_run(
    on_progress: OnProgress, should_stop: Callable[[], bool], stage: Stage = "preparing"
) -> Callable[[str], None]:
    """A callback for what is being done while the input is read; it reports each change once.

    It raises `Interrupted` if ``should_stop`` returns true.
    """
    last = ""

    def watch(what: str) -> None:
        nonlocal last
        if should_stop():
            raise Interrupted(f"stopped while {what}; run again to go on")
        if what != last:
            on_progress(Progress(stage=stage, message=what))
            last = what

    return watch


@dataclass(frozen=True)
class Monitor:
    """The callbacks of a caller that follows a run.

    Attributes:
        on_progress: called with each `Progress`.
        should_stop: called after every step, view, frame and photo; once true, the run ends with `Interrupted`.
        forecast: gives each report the fraction done and the time left.
    """

    on_progress: OnProgress = lambda _progress: None
    should_stop: Callable[[], bool] = lambda: False
    forecast: Forecast = field(default_factory=Forecast)

    def report(self, progress: Progress) -> None:
        """Report what is being done, with the current fraction and time left."""
        fraction, eta_s = self.forecast.now()
        metrics = {**progress.metrics, "machine_busy": float(self.forecast.machine_is_busy())}
        self.on_progress(
            progress.model_copy(update={"fraction": fraction, "eta_s": eta_s, "metrics": metrics})
        )

    def report_end(self, steps: int) -> None:
        """Report that the run is complete, after so many steps."""
        self.on_progress(Progress(stage="exporting", step=steps, steps_total=steps, fraction=1.0, eta_s=0.0))

    def raise_if_stopped(self, message: str) -> None:
        """Raise `Interrupted` with ``message`` if the run is to stop."""
        if self.should_stop():
            raise Interrupted(message)
