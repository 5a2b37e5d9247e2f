"""Options of a refinement: one declaration for the command line, the HTTP schema and config.json.

Each is declared once, in `_Options`. `RefineOptions` are those requested, None for the value of the preset;
`ResolvedOptions` have every value filled in.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Annotated, Any, Generic, Literal, Never, Self, TypeVar

from pydantic import (
    AfterValidator,
    BaseModel,
    ConfigDict,
    Field,
    ValidationError,
    field_validator,
    model_validator,
)

from biresnerf.options.formats import ExportName, PosesOf
from biresnerf.options.given_poses import PoseReading, refuse_contradictions
from biresnerf.options.option import ONCE, Option, all_required, divided, lowered
from biresnerf.options.presets import (
    FEWEST_OF_STAGE,
    FEWEST_STEPS,
    PRESET_IF_LEFT_OUT,
    PRESET_ON,
    ComputeDevice,
    MethodName,
    PresetName,
    in_proportion,
    preset_values,
)
from biresnerf.options.validated_options import validated, with_near_names
from biresnerf.stages import STAGES

Device = Literal["auto", "cpu", "cuda"]
Background = Literal["auto", "white", "black", "none"]
ExposureChoice = Literal["auto", "none", "on"]
StartPoses = Literal["auto", "given", "colmap", "none", "turntable"]
RefineIntrinsics = Literal["auto", "none", "focal", "all"]
SeedingEffort = Literal["full", "low"]
Names = Annotated[tuple[str, ...], *ONCE]
Readings = Annotated[tuple[PoseReading, ...], *ONCE, AfterValidator(refuse_contradictions)]
Exports = Annotated[tuple[ExportName, ...], *ONCE]
HeldOut = Annotated[int, Field(ge=0, le=200)] | Literal["auto"]

# What a field may hold instead of a value: None while requested, nothing (Never) once resolved.
Open = TypeVar("Open")
DeviceName = TypeVar("DeviceName")
# Defaults of fields with these types; `ResolvedOptions` refuses them.
OPEN: Any = None
AUTO: Any = "auto"


class _Options(BaseModel, Generic[Open, DeviceName]):
    """The declarations of all options. Unknown keys are refused, and so is text where a number is meant."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False, strict=True)

    preset: Annotated[PresetName | Open, Option("coarse", "Preset", level="usual")] = Field(
        OPEN,
        description=f"Provides the value of every option that is left out. Default: {PRESET_IF_LEFT_OUT}.",
    )
    method: Annotated[MethodName, Option("coarse", "Method", level="research")] = Field(
        "biresnerf",
        description="biresnerf-paper: the two stages as published; those after it: other published methods.",
    )
    field: Annotated[Literal["kernels", "reference"], Option("coarse", "Field", level="research")] = Field(
        "kernels",
        description="What computes a field of grids. reference: plain torch, many times slower, to try changes.",
    )
    device: Annotated[DeviceName, Option("coarse", "Compute on", level="usual")] = Field(
        AUTO, description="Where to compute; auto: on a CUDA GPU if there is one."
    )
    seed: Annotated[int, Option("seeding", "Random seed", level="usual")] = Field(
        0,
        ge=0,
        lt=2**31,
        description="On one CPU the same seed gives the same result, unless COLMAP maps photos: its threads "
        "make it differ from run to run.",
    )
    threads: Annotated[int, Option("coarse", "CPU threads", changes_result=False)] = Field(
        0, ge=0, le=256, description="CPU threads; 0: all cores that the process may use."
    )
    max_image_size: Annotated[
        int | Open, Option("coarse", "Working image size", level="usual", smaller=divided(2, 64))
    ] = Field(
        OPEN,
        ge=16,
        le=4096,
        description="Long side (px) of images during optimisation; results are full size. Left out, images are up to "
        "four times larger where a thing before a background fills less than half of them.",
    )
    holdout: Annotated[HeldOut | Open, Option("coarse", "Held-out views", level="usual")] = Field(
        OPEN, description="Views excluded from training, to measure quality; auto: a tenth, at most 10."
    )
    background: Annotated[Background, Option("coarse", "Background", level="usual")] = Field(
        "auto",
        description="Colour behind the scene. none: photos show surroundings; auto: the colour is detected.",
    )
    exposure: Annotated[ExposureChoice | Open, Option("coarse", "Exposure", level="usual")] = Field(
        OPEN,
        description="on: estimate a brightness factor for each photo; none: all photos are equally bright; auto: on if "
        "opaque photos differ in brightness.",
    )
    start: Annotated[StartPoses | Open, Option("seeding", "Starting poses", level="main")] = Field(
        OPEN,
        description="Where to start from. auto: your poses, with COLMAP filling the gaps, and whichever start scores "
        "better where both exist; given: your poses only; colmap: COLMAP's poses only; none: no feature matching, "
        "missing poses are guessed from similar photos; turntable: the photos go once around an object, in the order "
        "of their names.",
    )
    seeding_effort: Annotated[
        SeedingEffort, Option("seeding", "Feature matching effort", smaller=lambda _: "low")
    ] = Field(
        "full",
        description="low: fewer features from smaller photos in one thread: takes less memory, places fewer photos.",
    )
    given_poses: Annotated[Readings, Option("seeding", "What given poses are", level="usual")] = Field(
        (),
        max_length=10,
        description="Where given poses are not what their format says. inverted: world to camera where camera to world "
        "is meant, or the reverse; transposed: rotations by columns for rows; opencv_axes, opengl_axes: of the "
        "cameras; wxyz, xyzw: order of quaternions; left_handed: as in Unity; rolled_90, rolled_180, rolled_270: "
        "photos were turned clockwise since.",
    )
    bad_frames: Annotated[Literal["leave_out", "refuse"], Option("seeding", "Bad frames")] = Field(
        "leave_out", description="Frames whose photo, pose or lens is missing or broken, where most are good."
    )
    photos: Annotated[Names, Option("seeding", "Photos to use")] = Field(
        (),
        max_length=10_000,
        description="Names of photos to use, as if the set had no others; empty: all of them.",
    )
    leave_out: Annotated[Names, Option("seeding", "Photos to leave out", level="usual")] = Field(
        (), max_length=10_000, description="Names of photos to treat as if they were not in the set."
    )
    video_frames: Annotated[int, Option("seeding", "Frames of videos", level="usual")] = Field(
        0, ge=0, le=2000, description="Sharp frames to take of videos; 0: 120, or as many as before."
    )
    panoramas: Annotated[Literal["auto", "all"], Option("seeding", "360° photos")] = Field(
        "auto",
        description="Which photos show all directions and are cut into views. auto: those that their metadata or the "
        "input's format call equirectangular; all: every one that is twice as wide as high and has no given lens.",
    )
    fixed: Annotated[Names, Option("coarse", "Photos to keep fixed", level="main")] = Field(
        (),
        max_length=10_000,
        description="Names of photos whose poses stay exactly as given; they define the result's frame.",
    )
    refine_intrinsics: Annotated[RefineIntrinsics, Option("coarse", "Lens", level="main")] = Field(
        "auto",
        description="What to refine of focal length, principal point and distortion. auto: lenses that were not given; "
        "all: every lens.",
    )
    input_rotation_deg: Annotated[float, Option("fine", "Accuracy of given rotations")] = Field(
        0.0,
        ge=0,
        le=180,
        description="How exact the given rotations are: standard deviation about each axis, degrees; 0: measured.",
    )
    input_position: Annotated[float, Option("fine", "Accuracy of given positions")] = Field(
        0.0,
        ge=0,
        le=1e9,
        description="How exact the given positions are: standard deviation along each axis, in the input's unit; 0: "
        "measured.",
    )
    known_distance: Annotated[str, Option("fine", "Scale", level="main", changes_result=False)] = Field(
        "",
        max_length=1000,
        description="Two photos, or two points of the input's world, and the metres between them; gives the scale: "
        "`a.jpg, b.jpg, 1.25` or `0 0 1, 2 0 1, 3.5`.",
    )
    steps: Annotated[int | Open, Option("coarse", "Steps", level="usual")] = Field(
        OPEN,
        ge=FEWEST_STEPS,
        le=1_000_000,
        description="Optimisation steps of both stages together; left open, half of the preset's where matches place "
        "most cameras.",
    )
    time_budget_s: Annotated[float, Option("coarse", "Time budget", level="main")] = Field(
        0.0,
        ge=0,
        le=1e6,
        description="Seconds the whole run may take: it does as many steps as fit; 0: no limit.",
    )
    coarse_steps_min: Annotated[int | Open, Option("coarse", "Shortest stage 1")] = Field(
        OPEN, ge=FEWEST_OF_STAGE, le=1_000_000, description="Shortest stage 1, steps."
    )
    coarse_steps_max: Annotated[int | Open, Option("coarse", "Longest stage 1")] = Field(
        OPEN,
        ge=FEWEST_OF_STAGE,
        le=1_000_000,
        description="Longest stage 1, steps, even if the error is not stable.",
    )
    check_every: Annotated[int | Open, Option("coarse", "Steps between checks")] = Field(
        OPEN, ge=5, le=1_000_000, description="Steps between two checks whether the error is stable."
    )
    samples_per_step: Annotated[
        int | Open, Option("coarse", "Samples per step", smaller=divided(4, 1024))
    ] = Field(
        OPEN, ge=1024, le=2**22, description="Field samples per step at the end of the coarse-to-fine ramp."
    )
    pose_rate: Annotated[float | Open, Option("coarse", "Pose rate at the start", level="research")] = Field(
        OPEN, gt=0, le=0.1, description="Pose learning rate at the start."
    )
    pose_rate_final: Annotated[float | Open, Option("coarse", "Pose rate at the end", level="research")] = (
        Field(OPEN, gt=0, le=0.1, description="Pose learning rate at the end.")
    )
    field_rate: Annotated[float | Open, Option("coarse", "Field rate at the start", level="research")] = (
        Field(OPEN, gt=0, le=0.5, description="Field learning rate at the start.")
    )
    field_rate_final: Annotated[float | Open, Option("coarse", "Field rate at the end", level="research")] = (
        Field(OPEN, gt=0, le=0.5, description="Field learning rate at the end.")
    )
    warmup_steps: Annotated[int | Open, Option("fine", "Warm-up steps", level="research")] = Field(
        OPEN,
        ge=1,
        le=1_000_000,
        description="Steps in which the reconstruction module's learning rate rises.",
    )
    double_pose_step: Annotated[bool | Open, Option("coarse", "Second pose step", level="research")] = Field(
        OPEN,
        description="Also update the poses with a second Adam at the field's learning rate, as BAA-NGP's code does.",
    )
    pose_levels: Annotated[int, Option("coarse", "Pose module: levels", level="research")] = Field(
        3, ge=1, le=16, description="Levels of the pose-estimation module."
    )
    pose_resolution_min: Annotated[int, Option("coarse", "Pose module: coarsest level", level="research")] = (
        Field(16, ge=2, le=128, description="Cells per side of its coarsest level.")
    )
    pose_resolution_max: Annotated[int, Option("coarse", "Pose module: finest level", level="research")] = (
        Field(72, ge=2, le=8192, description="Cells per side of its finest level.")
    )
    reconstruction_levels: Annotated[
        int | Open, Option("fine", "Reconstruction module: levels", level="research")
    ] = Field(OPEN, ge=1, le=16, description="Levels of the reconstruction module.")
    reconstruction_resolution_min: Annotated[
        int | Open, Option("fine", "Reconstruction module: coarsest level", level="research")
    ] = Field(OPEN, ge=4, le=8192, description="Cells per side of its coarsest level.")
    reconstruction_resolution_max: Annotated[
        int | Open, Option("fine", "Reconstruction module: finest level", level="research")
    ] = Field(OPEN, ge=4, le=16384, description="Cells per side of its finest level.")
    table_size_log2: Annotated[int | Open, Option("fine", "Table size", smaller=lowered(2, 10))] = Field(
        OPEN, ge=10, le=22, description="log2 of the entries of a hashed level."
    )
    verdict: Annotated[bool, Option("evaluating", "Verdict")] = Field(
        True,
        description="Compare the refined poses with the input's at the end, and return the input's unless the refined "
        "ones are better; false: always return the refined ones.",
    )
    trial_steps: Annotated[int | Open, Option("evaluating", "Steps of the verdict")] = Field(
        OPEN,
        ge=0,
        le=100_000,
        description="Steps of each of the verdict's two short trainings, twice as many for scenes with surroundings; "
        "0: none.",
    )
    checkpoint_every_s: Annotated[
        float, Option("coarse", "Seconds between checkpoints", changes_result=False)
    ] = Field(20.0, ge=1, le=86_400, description="Seconds between checkpoints.")
    orbit_frames: Annotated[
        int | Open, Option("evaluating", "Frames of the orbit video", changes_result=False)
    ] = Field(OPEN, ge=0, le=600, description="Frames of the orbit video; 0: no video.")
    shown_views: Annotated[int | Open, Option("evaluating", "Views to render", changes_result=False)] = Field(
        OPEN,
        ge=0,
        le=200,
        description="Views to render for display besides the held-out ones; fewer if they would take more than a "
        "twentieth of the run.",
    )
    exports: Annotated[
        Exports, Option("exporting", "Further formats", level="main", changes_result=False)
    ] = Field(
        (),
        description="Further formats to write the result in; pinhole: undistorted photos with a PINHOLE model.",
    )
    poses_of: Annotated[PosesOf, Option("exporting", "Poses of", level="usual", changes_result=False)] = (
        Field(
            "camera",
            description="body: where given poses are those of a robot's flange, a phone or another body that carries "
            "the camera, body/ holds the poses of that body as well, in the formats of poses alone.",
        )
    )

    @model_validator(mode="wrap")
    @classmethod
    def _known(cls, values: Any, validate: Callable[[Any], Self]) -> Self:
        try:
            return validate(values)
        except ValidationError as error:
            raise with_near_names(error, cls) from None

    @field_validator("holdout", mode="wrap")
    @classmethod
    def _counted(cls, value: Any, validate: Callable[[Any], Any]) -> Any:
        """One error for the field, where pydantic reports one for each type of the union."""
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


class ResolvedOptions(_Options[Never, ComputeDevice]):
    """Options of one refinement with every value filled in for the device that runs it."""

    model_config = ConfigDict(title="Resolved options", validate_default=True, json_schema_extra=all_required)

    def with_steps(self, steps: int) -> ResolvedOptions:
        """The same with so many steps; values in proportion to them are scaled."""
        return self.model_copy(update={"steps": steps, **in_proportion(self.model_dump(), steps)})


class RefineOptions(_Options[None, Device]):
    """Options of one refinement. Unknown keys are refused."""

    model_config = ConfigDict(title="Refinement options")

    def resolved(self, device: ComputeDevice) -> ResolvedOptions:
        """Fill in every value that was left out, from the method and the preset, for the device that will run it.

        Raises:
            InputError: ``invalid_options``: the requested values contradict those of the preset.
        """
        preset = self.preset or PRESET_ON[device]
        values = {"preset": preset, **preset_values(preset, self.method, device, self.steps)}
        return validated(ResolvedOptions, {**values, **self.model_dump(exclude_none=True), "device": device})


OPTIONS: Mapping[str, Option] = {
    name: next(item for item in field.metadata if isinstance(item, Option))
    for name, field in RefineOptions.model_fields.items()
}
# A run resumes from a checkpoint only if all of RESULT_OPTIONS agree, and takes over another run's stage 1 only if all
# of STAGE_1_OPTIONS do.
RESULT_OPTIONS = frozenset(name for name, option in OPTIONS.items() if option.changes_result)
STAGE_1_OPTIONS = frozenset(
    name for name in RESULT_OPTIONS if STAGES.index(OPTIONS[name].stage) <= STAGES.index("coarse")
)


def parse_options(values: Mapping[str, Any]) -> RefineOptions:
    """Options from untrusted values; raises `InputError` with the path of every wrong key."""
    return validated(RefineOptions, values)
