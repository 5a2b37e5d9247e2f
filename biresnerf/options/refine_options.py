"""What a user may ask for: frozen models that give the CLI flags, the HTTP schema and config.json alike.

A field left at ``None`` takes the preset's value; ``RefineOptions.resolved()`` fills them all in.
"""

from __future__ import annotations

from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator, model_validator

from biresnerf.errors import InputError
from biresnerf.options.presets import (
    COMMON_VALUES,
    CUDA_SCALE,
    METHOD_PAPER_VALUES,
    METHOD_VALUES,
    PRESETS,
    MethodName,
    PresetName,
)

Device = Literal["auto", "cpu", "cuda"]
Background = Literal["auto", "white", "black", "none"]
ExposureChoice = Literal["auto", "none", "on"]
Wiring = Literal["concat", "replace", "residual"]
DetectorName = Literal["trend", "counter", "variance"]
PoseParametrisation = Literal["se3_world", "so3xr3", "so3xr3_camp"]
PackName = Literal["colmap-text", "instant-ngp", "kitti", "bundler", "pinhole"]
StartPoses = Literal["auto", "given", "colmap", "none"]
RefineIntrinsics = Literal["auto", "none", "focal", "all"]
SeedingEffort = Literal["full", "low"]

# Options that have no say before stage 2 begins: runs that differ in these alone can share stage 1.
STAGE_2_OPTIONS = frozenset(
    {
        *("reconstruction_levels", "reconstruction_resolution_min", "reconstruction_resolution_max"),
        *("table_size_log2", "wiring", "warmup_steps", "verdict", "trial_steps"),
        *("threads", "checkpoint_every_s", "orbit_frames", "shown_views", "packs"),
    }
)


class RefineOptions(BaseModel):
    """Options of one refinement. Unknown keys are refused."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False, title="Refinement options")

    preset: PresetName = Field("balanced", description="Fills every option that is left out.")
    method: MethodName = Field(
        "biresnerf",
        description="biresnerf; the two stages as published, biresnerf-paper; or what it is compared with.",
    )
    device: Device = Field("auto", description="Where to compute; auto takes CUDA where there is one.")
    seed: int = Field(0, ge=0, lt=2**31, description="Same seed, same machine, same result on the CPU.")
    threads: int = Field(0, ge=0, le=256, description="CPU threads; 0 takes all cores this process may use.")

    max_image_size: int | None = Field(
        None,
        ge=16,
        le=4096,
        description="Long side (px) that images are optimised at; results are full size.",
    )
    holdout: int | None = Field(
        None,
        ge=0,
        le=200,
        description="Views kept out of the field's training, to measure it. Default: a tenth.",
    )
    background: Background = Field(
        "auto", description="What lies behind the scene: a colour, or none where photos show surroundings."
    )

    exposure: ExposureChoice | None = Field(
        None,
        description="on: find how bright each photo is against the others, with poses and field; none: all alike; "
        "auto: on where opaque photos differ in brightness.",
    )
    start: StartPoses | None = Field(
        None,
        description="auto: feature matches find missing poses, and poses they support are tried against the given "
        "ones; given: the given poses, of all images; colmap: COLMAP's poses, whatever is given; none: no feature "
        "matches, missing poses are guessed from other images.",
    )

    seeding_effort: SeedingEffort = Field(
        "full",
        description="low: COLMAP looks for fewer features in smaller photos, in one thread; it takes less memory and "
        "places fewer photos.",
    )

    fixed: tuple[str, ...] = Field(
        (),
        max_length=10_000,
        description="Names of images whose poses stay as given, to the bit; the result's frame is tied to them.",
    )

    refine_intrinsics: RefineIntrinsics = Field(
        "auto",
        description="What of the lenses is refined too; auto: focal lengths that were guessed or read from EXIF; all: "
        "principal point and distortion as well.",
    )

    steps: int | None = Field(None, ge=20, le=1_000_000, description="Steps of both stages together.")
    coarse_steps_min: int | None = Field(None, ge=10, description="Stage 1 takes at least this many steps.")
    coarse_steps_max: int | None = Field(None, ge=10, description="Stage 1 ends here, stable or not.")
    check_every: int | None = Field(
        None, ge=5, description="Steps between two looks of the stability detector."
    )
    detector: DetectorName = Field(
        "trend",
        description="What calls the error stable: a flat line through it, as many rises as falls, or a small variance.",
    )
    samples_per_step: int | None = Field(
        None, ge=1024, le=2**22, description="Field samples a step at the end of the coarse-to-fine ramp."
    )

    pose_rate: float | None = Field(None, gt=0, le=0.1, description="Pose learning rate at the start.")
    pose_rate_final: float | None = Field(None, gt=0, le=0.1, description="Pose learning rate at the end.")
    field_rate: float | None = Field(None, gt=0, le=0.5, description="Field learning rate at the start.")
    field_rate_final: float | None = Field(None, gt=0, le=0.5, description="Field learning rate at the end.")
    warmup_steps: int | None = Field(
        None, ge=1, description="Steps over which the reconstruction module's learning rate rises."
    )
    double_pose_step: bool | None = Field(
        None,
        description="A second Adam, at the field's learning rate, moves the poses too (as BAA-NGP's code).",
    )
    pose_parametrisation: PoseParametrisation = Field(
        "se3_world",
        description="se3_world turns cameras about the scene, so3xr3 about themselves, so3xr3_camp with CamP's "
        "preconditioner.",
    )

    wiring: Wiring = Field(
        "concat",
        description="How the reconstruction module joins: beside the pose-estimation module's features, in their "
        "place with fresh networks, or with networks of its own whose outputs are added.",
    )
    pose_levels: int = Field(3, ge=1, le=16, description="Levels of the pose-estimation module.")
    pose_resolution_min: int = Field(16, ge=2, le=128, description="Cells a side of its coarsest level.")
    pose_resolution_max: int = Field(72, ge=2, le=8192, description="Cells a side of its finest level.")
    reconstruction_levels: int | None = Field(
        None, ge=1, le=16, description="Levels of the reconstruction module."
    )
    reconstruction_resolution_min: int | None = Field(
        None, ge=4, le=8192, description="Cells a side of its coarsest level."
    )
    reconstruction_resolution_max: int | None = Field(
        None, ge=4, le=16384, description="Cells a side of its finest level."
    )
    table_size_log2: int | None = Field(None, ge=10, le=22, description="Entries of a hashed level, log2.")

    verdict: bool = Field(
        True,
        description="At the end, compare the refined poses with the input's, and return the input's unless the refined "
        "ones are better; without it the refined ones are returned.",
    )
    trial_steps: int | None = Field(
        None,
        ge=0,
        le=100_000,
        description="Steps of each of the verdict's two short trainings (scenes with surroundings take twice as many); "
        "0 leaves them out.",
    )

    checkpoint_every_s: float = Field(20.0, gt=0, description="Seconds between two checkpoints.")
    orbit_frames: int | None = Field(
        None, ge=0, le=600, description="Frames of the orbit video; 0 leaves it out."
    )
    shown_views: int | None = Field(
        None,
        ge=0,
        le=200,
        description="Views rendered at the end beside the held-out ones, spread over the set, to be looked at; fewer "
        "where they would take more than a twentieth of the run.",
    )
    packs: tuple[PackName, ...] = Field(
        (),
        description="Forms to write the result in beside those that always are: colmap-text, instant-ngp, kitti, "
        "bundler, pinhole (undistorted photos with a PINHOLE model).",
    )

    @field_validator("fixed", "packs", mode="before")
    @classmethod
    def _listed(cls, value: Any) -> Any:
        """A list may be written with commas, as on a command line."""
        return tuple(part.strip() for part in value.split(",")) if isinstance(value, str) else value

    @model_validator(mode="after")
    def _ordered(self) -> RefineOptions:
        pairs = (
            ("coarse_steps_min", "coarse_steps_max"),
            ("coarse_steps_max", "steps"),
            ("pose_rate_final", "pose_rate"),
            ("field_rate_final", "field_rate"),
            ("pose_resolution_min", "pose_resolution_max"),
            ("reconstruction_resolution_min", "reconstruction_resolution_max"),
        )
        for low, high in pairs:
            a, b = getattr(self, low), getattr(self, high)
            if a is not None and b is not None and a > b:
                raise ValueError(f"{low} ({a}) must not exceed {high} ({b})")
        return self

    def resolved(self) -> RefineOptions:
        """These options with every field left at ``None`` filled in from the preset (``holdout`` stays)."""
        preset = {**COMMON_VALUES, **PRESETS[self.preset], **METHOD_VALUES[self.method]}
        if self.preset == "paper":
            preset.update(METHOD_PAPER_VALUES[self.method])
        given = self.model_dump()
        scale = CUDA_SCALE if self.device == "cuda" and self.preset != "paper" else {}
        filled = {
            key: preset[key] * scale[key] if key in scale else preset[key]
            for key in preset
            if given[key] is None
        }
        # A shorter run asked for by `steps` alone keeps the preset's proportions.
        if self.steps is not None:
            ratio = self.steps / preset["steps"]
            for key in ("coarse_steps_min", "coarse_steps_max", "check_every", "warmup_steps"):
                if given[key] is None:
                    filled[key] = max(10, round(preset[key] * ratio))
            if self.trial_steps is None:
                # In proportion they would be too short to tell good poses from better ones.
                filled["trial_steps"] = max(10, min(preset["trial_steps"], self.steps // 4))
        return parse_options({**given, **filled})


def parse_options(values: dict[str, Any]) -> RefineOptions:
    """Options from untrusted values; raises `InputError` naming the path of every key that is wrong."""
    try:
        return RefineOptions.model_validate(values)
    except ValidationError as error:
        problems = []
        for item in error.errors():
            path = ".".join(str(part) for part in item["loc"]) or "options"
            known = "unknown option" if item["type"] == "extra_forbidden" else item["msg"]
            problems.append(f"{path}: {known}")
        raise InputError(
            "invalid_options",
            "; ".join(problems) + ".",
            where="options",
            hint="`biresnerf refine --help` and GET /v1/options list what there is.",
        ) from None
