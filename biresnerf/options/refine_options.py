"""What a user can ask for: frozen models that give the CLI flags, the HTTP schema and config.json alike.

Each option is declared once, in `_Options`. `RefineOptions` is what was asked, where None leaves a value to the
preset; `ResolvedOptions` is the same with every value filled in.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Annotated, Any, Generic, Literal, Never, Self, TypeVar

from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator, model_validator

from biresnerf.errors import InputError
from biresnerf.options.formats import ExportName
from biresnerf.options.option import Option
from biresnerf.options.presets import ComputeDevice, MethodName, PresetName, preset_values
from biresnerf.stages import STAGES

Device = Literal["auto", "cpu", "cuda"]
Background = Literal["auto", "white", "black", "none"]
ExposureChoice = Literal["auto", "none", "on"]
Wiring = Literal["concat", "replace", "residual"]
DetectorName = Literal["trend", "counter", "variance"]
PoseParametrisation = Literal["se3_world", "so3xr3", "so3xr3_camp"]
StartPoses = Literal["auto", "given", "colmap", "none"]
RefineIntrinsics = Literal["auto", "none", "focal", "all"]
SeedingEffort = Literal["full", "low"]
Exports = tuple[ExportName, ...]
HeldOut = Annotated[int, Field(ge=0, le=200)] | Literal["auto"]

# What else a field may hold: None in what was asked, nothing else once resolved.
Open = TypeVar("Open")
DeviceName = TypeVar("DeviceName")
# Defaults of fields with those types; `ResolvedOptions` refuses them.
OPEN: Any = None
AUTO: Any = "auto"


class _Options(BaseModel, Generic[Open, DeviceName]):
    """The declarations of all options. Unknown keys are refused."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    preset: Annotated[PresetName, Option("coarse", level="usual")] = Field(
        "balanced", description="Fills every option that is left out."
    )
    method: Annotated[MethodName, Option("coarse", level="research")] = Field(
        "biresnerf",
        description="biresnerf; the two stages as published, biresnerf-paper; or what it is compared with.",
    )
    device: Annotated[DeviceName, Option("coarse", level="usual")] = Field(
        AUTO, description="Where to compute; auto takes CUDA where there is one."
    )
    seed: Annotated[int, Option("seeding", level="usual")] = Field(
        0, ge=0, lt=2**31, description="Same seed, same machine, same result on the CPU."
    )
    threads: Annotated[int, Option("coarse", changes_result=False)] = Field(
        0, ge=0, le=256, description="CPU threads; 0 takes all cores this process may use."
    )
    max_image_size: Annotated[
        int | Open, Option("coarse", level="usual", less_memory=lambda px: min(px, max(64, px // 2)))
    ] = Field(
        OPEN,
        ge=16,
        le=4096,
        description="Long side (px) that images are optimised at; results are full size.",
    )
    holdout: Annotated[HeldOut | Open, Option("coarse", level="usual")] = Field(
        OPEN, description="Views kept out of the field's training, to measure it; auto: a tenth, at most 10."
    )
    background: Annotated[Background, Option("coarse", level="usual")] = Field(
        "auto", description="What lies behind the scene: a colour, or none where photos show surroundings."
    )
    exposure: Annotated[ExposureChoice | Open, Option("coarse", level="usual")] = Field(
        OPEN,
        description="on: find how bright each photo is against the others, with poses and field; none: all alike; "
        "auto: on where opaque photos differ in brightness.",
    )
    start: Annotated[StartPoses | Open, Option("seeding", level="usual")] = Field(
        OPEN,
        description="auto: feature matches find missing poses, and poses they support are tried against the given "
        "ones; given: the given poses, of all images; colmap: COLMAP's poses, whatever is given; none: no feature "
        "matches, missing poses are guessed from other images.",
    )
    seeding_effort: Annotated[SeedingEffort, Option("seeding", less_memory=lambda _: "low")] = Field(
        "full",
        description="low: COLMAP looks for fewer features in smaller photos, in one thread; it takes less memory and "
        "places fewer photos.",
    )
    fixed: Annotated[tuple[str, ...], Option("coarse", level="usual")] = Field(
        (),
        max_length=10_000,
        description="Names of images whose poses stay as given, to the bit; the result's frame is tied to them.",
    )
    refine_intrinsics: Annotated[RefineIntrinsics, Option("coarse", level="usual")] = Field(
        "auto",
        description="What of the lenses is refined too; auto: focal lengths that were guessed or read from EXIF; all: "
        "principal point and distortion as well.",
    )
    steps: Annotated[int | Open, Option("coarse", level="usual")] = Field(
        OPEN, ge=20, le=1_000_000, description="Steps of both stages together."
    )
    coarse_steps_min: Annotated[int | Open, Option("coarse")] = Field(
        OPEN, ge=10, description="Stage 1 takes at least this many steps."
    )
    coarse_steps_max: Annotated[int | Open, Option("coarse")] = Field(
        OPEN, ge=10, description="Stage 1 ends here, stable or not."
    )
    check_every: Annotated[int | Open, Option("coarse")] = Field(
        OPEN, ge=5, description="Steps between two looks of the stability detector."
    )
    detector: Annotated[DetectorName, Option("coarse", level="research")] = Field(
        "trend",
        description="What calls the error stable: a flat line through it, as many rises as falls, or a small variance.",
    )
    samples_per_step: Annotated[
        int | Open, Option("coarse", less_memory=lambda samples: max(1024, samples // 4))
    ] = Field(
        OPEN, ge=1024, le=2**22, description="Field samples a step at the end of the coarse-to-fine ramp."
    )
    pose_rate: Annotated[float | Open, Option("coarse")] = Field(
        OPEN, gt=0, le=0.1, description="Pose learning rate at the start."
    )
    pose_rate_final: Annotated[float | Open, Option("coarse")] = Field(
        OPEN, gt=0, le=0.1, description="Pose learning rate at the end."
    )
    field_rate: Annotated[float | Open, Option("coarse")] = Field(
        OPEN, gt=0, le=0.5, description="Field learning rate at the start."
    )
    field_rate_final: Annotated[float | Open, Option("coarse")] = Field(
        OPEN, gt=0, le=0.5, description="Field learning rate at the end."
    )
    warmup_steps: Annotated[int | Open, Option("fine", level="research")] = Field(
        OPEN, ge=1, description="Steps over which the reconstruction module's learning rate rises."
    )
    double_pose_step: Annotated[bool | Open, Option("coarse", level="research")] = Field(
        OPEN,
        description="A second Adam, at the field's learning rate, moves the poses too (as BAA-NGP's code).",
    )
    pose_parametrisation: Annotated[PoseParametrisation, Option("coarse", level="research")] = Field(
        "se3_world",
        description="se3_world turns cameras about the scene, so3xr3 about themselves, so3xr3_camp with CamP's "
        "preconditioner.",
    )
    wiring: Annotated[Wiring, Option("fine", level="research")] = Field(
        "concat",
        description="How the reconstruction module joins: beside the pose-estimation module's features, in their "
        "place with fresh networks, or with networks of its own whose outputs are added.",
    )
    pose_levels: Annotated[int, Option("coarse", level="research")] = Field(
        3, ge=1, le=16, description="Levels of the pose-estimation module."
    )
    pose_resolution_min: Annotated[int, Option("coarse", level="research")] = Field(
        16, ge=2, le=128, description="Cells a side of its coarsest level."
    )
    pose_resolution_max: Annotated[int, Option("coarse", level="research")] = Field(
        72, ge=2, le=8192, description="Cells a side of its finest level."
    )
    reconstruction_levels: Annotated[int | Open, Option("fine", level="research")] = Field(
        OPEN, ge=1, le=16, description="Levels of the reconstruction module."
    )
    reconstruction_resolution_min: Annotated[int | Open, Option("fine", level="research")] = Field(
        OPEN, ge=4, le=8192, description="Cells a side of its coarsest level."
    )
    reconstruction_resolution_max: Annotated[int | Open, Option("fine", level="research")] = Field(
        OPEN, ge=4, le=16384, description="Cells a side of its finest level."
    )
    table_size_log2: Annotated[int | Open, Option("fine", less_memory=lambda log2: max(10, log2 - 2))] = (
        Field(OPEN, ge=10, le=22, description="Entries of a hashed level, log2.")
    )
    verdict: Annotated[bool, Option("evaluating")] = Field(
        True,
        description="At the end, compare the refined poses with the input's, and return the input's unless the refined "
        "ones are better; without it the refined ones are returned.",
    )
    trial_steps: Annotated[int | Open, Option("evaluating")] = Field(
        OPEN,
        ge=0,
        le=100_000,
        description="Steps of each of the verdict's two short trainings (scenes with surroundings take twice as many); "
        "0 leaves them out.",
    )
    checkpoint_every_s: Annotated[float, Option("coarse", changes_result=False)] = Field(
        20.0, gt=0, description="Seconds between two checkpoints."
    )
    orbit_frames: Annotated[int | Open, Option("evaluating", changes_result=False)] = Field(
        OPEN, ge=0, le=600, description="Frames of the orbit video; 0 leaves it out."
    )
    shown_views: Annotated[int | Open, Option("evaluating", changes_result=False)] = Field(
        OPEN,
        ge=0,
        le=200,
        description="Views rendered at the end beside the held-out ones, spread over the set, to be looked at; fewer "
        "where they would take more than a twentieth of the run.",
    )
    exports: Annotated[Exports, Option("exporting", level="usual", changes_result=False)] = Field(
        (),
        description="Formats to write the result in, beside those that every result has; pinhole: undistorted photos "
        "with a PINHOLE model.",
    )

    @field_validator("fixed", "exports", mode="before")
    @classmethod
    def _listed(cls, value: Any) -> Any:
        """A list may be written with commas, as on a command line."""
        return tuple(part.strip() for part in value.split(",")) if isinstance(value, str) else value

    @field_validator("holdout", mode="wrap")
    @classmethod
    def _counted(cls, value: Any, validate: Callable[[Any], Any]) -> Any:
        """One error for the whole field, where pydantic has one for each of the types that it may have."""
        try:
            return validate(value)
        except ValidationError:
            raise ValueError("must be auto or a whole number from 0 to 200") from None

    @model_validator(mode="after")
    def _ordered(self) -> Self:
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


def _all_required(schema: dict[str, Any]) -> None:
    """Resolved options have no defaults."""
    schema["required"] = list(schema["properties"])
    for field in schema["properties"].values():
        field.pop("default", None)


class ResolvedOptions(_Options[Never, ComputeDevice]):
    """Options of one refinement with every value filled in for the device that runs it."""

    model_config = ConfigDict(
        title="Resolved options", validate_default=True, json_schema_extra=_all_required
    )


class RefineOptions(_Options[None, Device]):
    """Options of one refinement. Unknown keys are refused."""

    model_config = ConfigDict(title="Refinement options")

    def resolved(self, device: ComputeDevice) -> ResolvedOptions:
        """Every value left open filled in: by the method, the preset, and for the device that runs it.

        Raises:
            InputError: ``invalid_options``: what was asked does not fit what the preset fills in.
        """
        values = preset_values(self.preset, self.method, device, self.steps)
        return _parse(ResolvedOptions, {**values, **self.model_dump(exclude_none=True), "device": device})


OPTIONS: Mapping[str, Option] = {
    name: next(item for item in field.metadata if isinstance(item, Option))
    for name, field in RefineOptions.model_fields.items()
}
# A run goes on from a checkpoint only where these agree, and takes over another's stage 1 where the second do.
RESULT_OPTIONS = frozenset(name for name, option in OPTIONS.items() if option.changes_result)
STAGE_1_OPTIONS = frozenset(
    name for name in RESULT_OPTIONS if STAGES.index(OPTIONS[name].stage) <= STAGES.index("coarse")
)

Parsed = TypeVar("Parsed", bound=BaseModel)


def parse_options(values: Mapping[str, Any]) -> RefineOptions:
    """Options from untrusted values; raises `InputError` naming the path of every key that is wrong."""
    return _parse(RefineOptions, values)


def _parse(model: type[Parsed], values: Mapping[str, Any]) -> Parsed:
    try:
        return model.model_validate(values)
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
