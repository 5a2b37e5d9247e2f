"""The machine-readable result of a refinement. No torch: the service reads it too."""

from __future__ import annotations

from typing import Any, Literal

from pydantic import Field, computed_field, model_validator

from biresnerf.errors import Fault
from biresnerf.frozen_model import FrozenModel
from biresnerf.options.refine_options import ResolvedOptions
from biresnerf.uncertainty import (
    ControlReport,
    GeoReference,
    InputAccuracy,
    KnownScale,
    PartsReport,
    PoseUncertainty,
)

SwitchReason = Literal["stable", "cap"]
IntrinsicsSource = Literal["given", "maker", "exif", "predicted", "colmap", "guessed", "refined"]
PoseSource = Literal[
    "given", "colmap", "matches-incremental", "matches-global", "matches-parts", "neighbours", "nearest-view",
    "forward-facing", "turntable", "gimbal",
]  # fmt: skip
CandidateName = Literal["input", "matched", "refined", "adjusted-tracks", "adjusted-patches", "adjusted"]
VerdictName = Literal["improved", "unchanged", "kept_input", "inconclusive", "failed_check"]
Finding = Literal["better", "worse", "same", "open"]


class PairedDifference(FrozenModel):
    """One figure for the input's poses and for the refined ones, measured on the same views or images.

    `difference` is the mean gain of the refined poses over these: positive is better, whatever the figure. The interval
    is Student's, at 95 %.
    """

    count: int = Field(examples=[18], description="Views or images that the figure was taken of.")
    before: float = Field(examples=[21.4], description="With the input's poses: the mean.")
    after: float = Field(examples=[24.9], description="With the refined poses: the mean.")
    difference: float = Field(examples=[3.5])
    low: float | None = Field(
        None, examples=[2.9], description="Lower end of the interval; None of fewer than two."
    )
    high: float | None = Field(None, examples=[4.1])
    finding: Finding = Field(
        description="better, worse, same (the interval holds nothing that would matter), or open (it holds too much)."
    )


class HeldOutEvidence(FrozenModel):
    """Two equal short trainings on poses held still, the input's and the refined ones, scored on unseen views."""

    protocol: Literal["frozen_retraining"] = "frozen_retraining"
    steps: int = Field(examples=[1000], description="Of each of the two trainings.")
    strictly: int = Field(
        examples=[6],
        description="Of the views: those that the refinement never trained its field on, either.",
    )
    psnr: PairedDifference = Field(description="dB.")
    ssim: PairedDifference
    missed_px: float | None = Field(
        None,
        examples=[1.3],
        description="By how many px, at working size, the photos would have to be shifted to differ from themselves as "
        "much as from their renders with the poses that fit them better: the median of the views. None in older "
        "reports.",
    )


class EpipolarEvidence(FrozenModel):
    """How well matched features fit the poses: each image's median symmetric epipolar error.

    The difference is the mean of log2(before / after) over images: 1 is half the error.
    """

    matches: int = Field(examples=[48_210])
    independent: bool = Field(
        description="Whether the start had nothing to do with these matches. If it had, they may speak against the "
        "refined poses, not for them."
    )
    error_px: PairedDifference = Field(
        description="Pixels of the full-size photos; before and after are medians."
    )
    share_of_image: float = Field(
        examples=[0.0004], description="The error after, as a share of the photos' long side."
    )


class Verdict(FrozenModel):
    """Whether the refined poses are better than the input's, and the reasons."""

    verdict: VerdictName
    returned: Literal["refined", "input"] = Field(
        description="Whose poses the result holds. Where it is the input's, refined/ holds the refined ones."
    )
    compared_with: Literal["given", "seeded", "mixed"] = Field(
        description="The input's poses: all the user's own, all found by us, or some of each."
    )
    why: tuple[str, ...] = Field(
        examples=[["Unseen views are predicted 3.50 dB better (95 %: 2.90 to 4.10)."]],
        description="The grounds in sentences, the weightiest first.",
    )
    moved_px: float = Field(
        examples=[4.2],
        description="How far the scene's middle moves in the image from the input's to the refined poses: median over "
        "cameras, px at working size.",
    )
    heldout: HeldOutEvidence | None = None
    epipolar: EpipolarEvidence | None = None

    def in_words(self) -> list[str]:
        """The verdict in one sentence, whose poses the result holds, and a line for each piece of evidence."""
        ground, *proofs = self.why
        name = "not improved" if self.verdict == "kept_input" else self.verdict.replace("_", " ")
        return [
            f"{name}: {ground} The result contains {self._returned_poses()}.",
            *(f"  {p}" for p in proofs),
        ]

    def _returned_poses(self) -> str:
        if self.returned == "refined":
            return "the refined poses"
        words = {
            "given": "your own poses",
            "seeded": "those of feature matches",
            "mixed": "the initial poses",
        }
        return f"{words[self.compared_with]}; the refined ones are in refined/"


class ImageReport(FrozenModel):
    """What became of one image. Lengths are in the input's own units."""

    name: str = Field(examples=["images/0001.jpg"])
    pose_source: PoseSource = Field(
        description="Who found the pose that the optimisation started from: the user, COLMAP from the images alone or "
        "beside the given poses, GPS and a drone's gimbal, or a guess from other images."
    )
    held_out: bool = Field(description="Never used to train the field.")
    fixed: bool = Field(False, description="Kept where it was, on request.")
    moved_deg: float = Field(
        examples=[1.31], description="Rotation between the given pose and the refined one, degrees."
    )
    moved_units: float = Field(
        examples=[0.042], description="Distance between the given camera centre and the refined one."
    )
    uncertainty: PoseUncertainty | None = Field(
        None, description="Of the returned pose; None of a partial result, and of methods of others."
    )
    repaired: bool = Field(False, description="It was lost, and brought back by trying many poses.")
    moved_far: bool = Field(False, description="Its pose moved by far more than the other images' did.")
    blurred: bool = Field(False, description="Far less sharp than photos taken from about the same place.")
    contradicted: bool = Field(False, description="Its own matches fit far worse than others' fit theirs.")
    exposure_off: bool = Field(False, description="Brighter or darker than the other photos make the scene.")
    sharpness: float | None = Field(
        None, description="Variance of the Laplacian over that of its neighbours' photos; at working size."
    )
    gain: float | None = Field(None, description="Brightness of the photo over that of its render.")
    exposure: tuple[float, float, float] | None = Field(
        None,
        description="The factors on red, green and blue that exposure compensation found; none without it.",
    )
    trial_psnr_before: float | None = Field(
        None,
        examples=[21.4],
        description="In the verdict's training on the input's poses, dB; its unseen views only.",
    )
    trial_psnr_after: float | None = Field(None, examples=[24.9], description="On the refined poses.")
    epipolar_px_before: float | None = Field(
        None, description="Median symmetric epipolar error of its feature matches with the input's poses, px."
    )
    epipolar_px_after: float | None = Field(None, description="The same with the refined poses.")
    psnr: float | None = Field(
        None, description="Render against photo at working size, dB; held-out views only."
    )
    ssim: float | None = Field(None, description="As psnr; Gaussian window of 11 px, standard deviation 1.5.")

    @computed_field(  # type: ignore[prop-decorator]  # mypy knows no decorated properties
        description="Whether feature matches or the photo itself support the returned pose, and its matches do not "
        "contradict it. None where its accuracy was not asked."
    )
    @property
    def confirmed(self) -> bool | None:
        if self.uncertainty is None:
            return None
        return self.uncertainty.why_unknown is None and not self.contradicted

    @model_validator(mode="before")
    @classmethod
    def _follow_confirmed(cls, data: Any) -> Any:
        """What files say of `confirmed` follows from the other fields."""
        return {k: v for k, v in data.items() if k != "confirmed"} if isinstance(data, dict) else data

    @property
    def flags(self) -> tuple[str, ...]:
        """The names of the fields that are true for the image."""
        return tuple(name for name, value in self if value is True)


class CameraReport(FrozenModel):
    """The intrinsics of one camera of the set, at full size: COLMAP's model, its parameters before and after."""

    model: str = Field(examples=["OPENCV"])
    width: int = Field(examples=[1920])
    height: int = Field(examples=[1080])
    source: IntrinsicsSource = Field(
        description="Who found the intrinsics that the optimisation started from."
    )
    refined: Literal["none", "focal", "all"] = Field(description="What of them the optimisation moved.")
    images: int = Field(examples=[60], description="How many images it took.")
    params_before: tuple[float, ...] = Field(examples=[[1500.0, 1500.0, 960.0, 540.0, 0.01, -0.02, 0.0, 0.0]])
    params_after: tuple[float, ...] = Field(examples=[[1501.2, 1501.2, 960.0, 540.0, 0.01, -0.02, 0.0, 0.0]])
    focal_deviation_percent: float | None = Field(
        None,
        examples=[0.08],
        description="Standard deviation of the focal length as feature matches and photos tell it, with what was known "
        "before. None where they were not asked, or say nothing.",
    )
    observable: bool | None = Field(
        None,
        description="Whether they tell the focal length: if not, it was kept. None where they were not asked.",
    )


class HeldOut(FrozenModel):
    """Mean quality of held-out views, their poses fitted to the frozen field first (BARF's test-time protocol)."""

    count: int = Field(examples=[6])
    psnr: float = Field(examples=[26.1])
    ssim: float = Field(examples=[0.84])
    unshared_opacity: float | None = Field(
        None,
        examples=[0.03],
        description="Share of the rendered opacity where fewer than two training cameras look: floaters, and what lies "
        "at the edge of the photos. None in reports of earlier versions.",
    )


class TrialReport(FrozenModel):
    """How well candidate start poses did: a short training with the poses fixed, scored on unseen views."""

    source: PoseSource
    placed: int = Field(
        examples=[60],
        description="Images whose pose comes from feature matches; the others keep the given one.",
    )
    psnr: float = Field(
        examples=[21.4], description="Mean over the unseen views, dB; only comparable within one run."
    )


class CandidateReport(FrozenModel):
    """Candidate poses for the result, judged by tracks and patches that none of them was fitted to.

    A misfit is the median over cameras of their mean robust square, in units of the measured noise: about 1 at poses
    that are as exact as the evidence, 9 where nothing fits.
    """

    name: CandidateName = Field(
        description="input: as given or seeded; matched: COLMAP's own model; refined: as the steps left them; "
        "adjusted: all cameras at once, to tracks of feature matches, to patches of photos, or to both."
    )
    track_misfit: float | None = Field(None, examples=[1.1], description="None without feature matches.")
    patch_misfit: float | None = Field(None, examples=[1.3])
    chosen: bool = False


class SimilarityReport(FrozenModel):
    """x_in_input = scale * rotation @ x_in_optimised + translation: ties the optimised poses to the input's frame."""

    scale: float = Field(examples=[2.4])
    rotation: tuple[tuple[float, float, float], ...] = Field(
        examples=[[[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]]
    )
    translation: tuple[float, float, float] = Field(examples=[[0.1, 0.0, -0.2]])


class PointsReport(FrozenModel):
    """The sparse points of the COLMAP model; docs/formats.md says what the sources are."""

    source: Literal["none", "given", "features", "tracks", "moved", "field"] = Field(examples=["features"])
    count: int = Field(examples=[5210])


class Report(FrozenModel):
    """``report.json``."""

    version: str = Field(examples=["0.1.0"])
    state: Literal["complete", "partial"] = Field(description="partial: stopped before the end, on request.")
    options: ResolvedOptions
    verdict: Verdict | None = Field(
        None, description="None of a partial result, and where none was asked for."
    )
    verdict_so_far: Verdict | None = Field(
        None, examples=[None], description="Of a preview or a partial result: by feature matches alone."
    )
    images: tuple[ImageReport, ...]
    cameras: tuple[CameraReport, ...] = ()
    heldout: HeldOut | None = Field(None, description="None where there were too few views to hold any out.")
    start_trials: tuple[TrialReport, ...] = Field(
        (),
        description="The poses that were tried to start from, if there was a choice; the given ones first.",
    )
    candidates: tuple[CandidateReport, ...] = Field(
        (),
        description="The poses that were compared at the end; one of them is the refined ones of the verdict.",
    )
    input_accuracy: InputAccuracy | None = Field(
        None, description="None where fewer than six poses were given, or nothing tells of them."
    )
    geo_reference: GeoReference | None = Field(None, description="None without measured positions.")
    control_points: ControlReport | None = Field(None, description="None without a list of them.")
    known_scale: KnownScale | None = Field(None, description="None without the option known_distance.")
    parts: PartsReport | None = Field(None, description="None where the set was refined as one.")
    steps_done: int = Field(examples=[2000])
    switch_step: int | None = Field(None, examples=[700], description="The step at which stage 2 began.")
    switch_reason: SwitchReason | None = Field(None, examples=["stable"])
    resumed: int = Field(0, description="How often the run went on from a checkpoint.")
    seconds: dict[str, float] = Field(
        default_factory=dict,
        examples=[{"coarse": 40.1, "fine": 71.9}],
        description="Wall time per stage; `compiling` is the wait for kernels in the first run on a machine.",
    )
    backend: str = Field(examples=["numba"])
    device: str = Field(examples=["cpu"])
    threads: int = Field(examples=[8])
    working_size: tuple[int, int] = Field(
        examples=[[160, 90]], description="Width and height, px, of the largest image as optimised."
    )
    input_from_optimised: SimilarityReport
    points: PointsReport | None = None
    warnings: tuple[str, ...] = ()
    faults: tuple[Fault, ...] = Field(
        (),
        description="What failed on our side: evidence is missing that the photos may hold, and no verdict is "
        "`improved` without it.",
    )
