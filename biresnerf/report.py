"""The machine-readable result of a refinement. No torch: the service reads it too."""

from __future__ import annotations

from typing import Literal

from pydantic import BaseModel, ConfigDict, Field

from biresnerf.config import RefineOptions

_FROZEN = ConfigDict(frozen=True, extra="forbid")

SwitchReason = Literal["stable", "cap"]
PoseSource = Literal[
    "given",
    "colmap",
    "matches-incremental",
    "matches-global",
    "neighbours",
    "nearest-view",
    "forward-facing",
]


class ImageReport(BaseModel):
    """What became of one image. Lengths are in the input's own units."""

    model_config = _FROZEN

    name: str
    pose_source: PoseSource = Field(
        description="Who found the pose that the optimisation started from: the user, COLMAP from the images alone or "
        "beside the given poses, or a guess from other images."
    )
    held_out: bool = Field(description="Never used to train the field.")
    fixed: bool = Field(False, description="Kept where it was, on request.")
    moved_deg: float = Field(description="Rotation between the given pose and the refined one, degrees.")
    moved_units: float = Field(description="Distance between the given camera centre and the refined one.")
    lost: bool = Field(
        False,
        description="Its pose never agreed with the others' field, and no better one was found: do not trust it.",
    )
    repaired: bool = Field(
        False, description="It was lost and took up its way again from a pose found by trying many."
    )
    psnr: float | None = Field(
        None, description="Render against photo at working size, dB; held-out views only."
    )
    ssim: float | None = Field(None, description="As psnr; Gaussian window of 11 px, standard deviation 1.5.")

    @property
    def flags(self) -> tuple[str, ...]:
        """The names of all that is true of the image."""
        return tuple(name for name, value in self if value is True)


class HeldOut(BaseModel):
    """Mean quality of held-out views, their poses fitted to the frozen field first (BARF's test-time protocol)."""

    model_config = _FROZEN

    count: int
    psnr: float
    ssim: float


class TrialReport(BaseModel):
    """How poses to start from did: a short training with them held still, scored on views it was not shown."""

    model_config = _FROZEN

    source: PoseSource
    placed: int = Field(
        description="Images whose pose comes from feature matches; the others keep the given one."
    )
    psnr: float = Field(description="Mean over the unseen views, dB; only comparable within one run.")


class SimilarityReport(BaseModel):
    """x_in_input = scale * rotation @ x_in_optimised + translation: ties the optimised poses to the input's frame."""

    model_config = _FROZEN

    scale: float
    rotation: tuple[tuple[float, float, float], ...]
    translation: tuple[float, float, float]


class Report(BaseModel):
    """``report.json``."""

    model_config = _FROZEN

    version: str
    state: Literal["complete", "partial"] = Field(description="partial: stopped before the end, on request.")
    options: RefineOptions
    images: tuple[ImageReport, ...]
    heldout: HeldOut | None = Field(None, description="None where there were too few views to hold any out.")
    start_trials: tuple[TrialReport, ...] = Field(
        (),
        description="The poses that were tried to start from, if there was a choice; the given ones first.",
    )
    steps_done: int
    switch_step: int | None = Field(None, description="The step at which stage 2 began.")
    switch_reason: SwitchReason | None = None
    resumed: int = Field(0, description="How often the run went on from a checkpoint.")
    seconds: dict[str, float] = Field(default_factory=dict, description="Wall time per stage.")
    backend: str
    device: str
    threads: int
    working_size: tuple[int, int] = Field(
        description="Width and height, px, of the largest image as optimised."
    )
    input_from_optimised: SimilarityReport
    warnings: tuple[str, ...] = ()
