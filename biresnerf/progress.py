"""Progress as data: what the pipeline tells whoever runs it. No torch, no text formatting."""

from __future__ import annotations

from collections.abc import Callable

from pydantic import BaseModel, ConfigDict, Field

from biresnerf.options.refine_options import ResolvedOptions
from biresnerf.stages import ReusableStage, Stage


class Progress(BaseModel):
    """One report of progress. ``fraction`` never falls within one run."""

    model_config = ConfigDict(frozen=True, extra="forbid")

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
