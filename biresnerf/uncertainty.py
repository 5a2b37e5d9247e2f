"""What a result states about the accuracy of poses, and about GPS. No torch: the service reads it too."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from biresnerf.frozen_model import FrozenModel

KnownFrom = Literal["matches", "photos", "matches and photos", "nothing"]
_Row = tuple[float, float, float, float, float, float]
Covariance = tuple[_Row, _Row, _Row, _Row, _Row, _Row]


class PoseUncertainty(FrozenModel, allow_inf_nan=False):
    """How far a returned pose may be from the true one, once the rigs are aligned.

    90 of 100 errors are within the bounds. All figures are None where they are not known.
    """

    known_from: KnownFrom = Field(description="What speaks for the pose beside the field.")
    rotation_deg: float | None = Field(None, examples=[0.08], description="90 % bound of its error.")
    position: float | None = Field(None, examples=[0.004], description="The centre's; the input's unit.")
    position_percent: float | None = Field(None, description="In percent of the cameras' distance.")
    covariance: Covariance | None = Field(
        None,
        description="Mean square errors, 6 x 6: of the rotation vector w (rad) with exp(w) R the true rotation, R the "
        "returned world_from_cam; then of the centre (the input's unit). Both along the axes of the input's world.",
    )
    why_unknown: str | None = Field(
        None,
        examples=["no feature matches or patches support them"],
        description="None where the bounds are known.",
    )


_Row4 = tuple[float, float, float, float]


class GeoReference(FrozenModel, allow_inf_nan=False):
    """Where the returned cameras lie among measured positions: GPS, or a table beside the photos.

    Positions also constrain the shape of the rig, weighted by stated accuracy or residuals, but not its frame.
    """

    source: str = Field(examples=["EXIF"], description="EXIF, or the file that has the positions.")
    images: int = Field(examples=[48], description="How many photos have a position.")
    used: int = Field(0, examples=[47], description="How many of them are not far beyond the others.")
    metres_from_world: tuple[_Row4, _Row4, _Row4, _Row4] | None = Field(
        None,
        description="4 x 4 similarity from the input's world to metres: along east, north and up from the place below, "
        "or in the frame of the positions. None where the positions do not tell it.",
    )
    why_not: str | None = Field(None, examples=["3 photos have a position, and 6 are needed"])
    doubt: str | None = Field(None, description="Where the residuals contradict the stated accuracy.")
    epsg: int | None = Field(
        None, examples=[4979], description="Of the place below, or of the frame of the positions, if known."
    )
    latitude: float | None = Field(None, examples=[50.0874], description="Degrees, north above zero.")
    longitude: float | None = Field(None, examples=[14.4213], description="Degrees, east above zero.")
    altitude: float | None = Field(None, examples=[195.0], description="Metres, as the positions have it.")
    accuracy_m: float | None = Field(
        None, examples=[5.0], description="Stated standard deviation along an axis, median; None: not stated."
    )
    residual_m: float | None = Field(
        None, examples=[2.1], description="Median distance of a camera from its position."
    )
    residuals_m: dict[str, float] = Field(
        default_factory=dict, description="That distance by the photo's name."
    )


class ControlPoint(FrozenModel, allow_inf_nan=False):
    """A measured point as the returned cameras see it."""

    name: str = Field(examples=["gcp02"])
    check: bool = Field(description="Nothing was adjusted to it.")
    images: int = Field(examples=[5], description="How many photos show it.")
    error_m: tuple[float, float, float] = Field(
        examples=[[0.012, -0.008, 0.021]], description="Where it is by them less where it was measured."
    )
    error_px: float = Field(
        examples=[0.6], description="Root mean square distance from its marks in the photos."
    )
    far_off: bool = Field(
        False, description="Its coordinates or marks are wrong by all that the others show."
    )


class ControlReport(FrozenModel, allow_inf_nan=False):
    """Control points and check points at the returned poses, after the similarity that fits the control points best."""

    source: str = Field(examples=["gcp_list.txt"])
    points: tuple[ControlPoint, ...] = ()
    control_m: float | None = Field(
        None, examples=[0.02], description="Root mean square distance of the control points."
    )
    control_px: float | None = Field(None, examples=[0.6])
    check_m: float | None = Field(
        None, examples=[0.03], description="Of the check points: the error to expect elsewhere."
    )
    check_px: float | None = Field(None, examples=[0.7])
    metres_from_world: tuple[_Row4, _Row4, _Row4, _Row4] | None = Field(
        None,
        description="4 x 4 similarity from the input's world to the points' frame, or to east, north and up.",
    )
    epsg: int | None = Field(None, examples=[32633], description="Of the frame, or of the origin.")
    origin: tuple[float, float, float] | None = Field(
        None, description="Latitude, longitude, height; None for a frame of metres."
    )
    why_not: str | None = Field(None, examples=["2 control points are seen in two photos, and 3 are needed"])
    doubt: str | None = Field(
        None, description="Which points contradict the photos, and by how much; None: none does."
    )


class KnownScale(FrozenModel, allow_inf_nan=False):
    """The scale that a known distance gives, at the returned poses. They are not changed by it."""

    between: tuple[str, str] = Field(examples=[["a.jpg", "b.jpg"]], description="Photos, or points.")
    metres: float = Field(examples=[1.25], description="The distance, as stated.")
    metres_per_unit: float = Field(examples=[0.31], description="Of the input's world.")


WEAK = 0.5  # of the photos at a seam; more are within honest bounds


NOT_REFINED = "part.json"  # in the place of a part's result: a `PartReport` that says why there is none


class PartReport(FrozenModel):
    """A part of a large set that was refined by itself."""

    name: str = Field(examples=["part-03"])
    photos: int = Field(examples=[400])
    why_not: str | None = Field(
        None,
        examples=["it shares fewer than 3 photos with the others"],
        description="Why it did not join the others; None: it did.",
    )


class SeamReport(FrozenModel, allow_inf_nan=False):
    """How far two parts disagree on the photos that both have, once one is carried onto the other by these."""

    parts: tuple[str, str] = Field(examples=[["part-03", "part-04"]])
    photos: int = Field(examples=[62], description="That both have.")
    rotation_deg: float = Field(examples=[0.02], description="Median.")
    rotation_deg_worst: float = Field(examples=[0.08])
    position: float = Field(examples=[0.01], description="Of the centres, median; the input's unit.")
    position_worst: float = Field(examples=[0.04])
    within: float | None = Field(
        None,
        examples=[0.95],
        description="Share of the photos on which the parts disagree by no more than their bounds for nine in ten "
        "errors allow, the mean of rotations and positions. None where no bounds are known.",
    )


class PartsReport(FrozenModel):
    """The parts that a result was joined from, before all cameras were adjusted together."""

    parts: tuple[PartReport, ...]
    seams: tuple[SeamReport, ...] = ()
    photos_left_out: int = Field(0, description="Which no part that joined has placed.")
    part_of: tuple[int | None, ...] = Field(
        (), description="Of each image: the part that its pose was taken from, counted from 0; None: of none."
    )
    apart_deg: tuple[float | None, ...] = Field(
        (),
        description="Of each image: rotation between its poses by the two parts that disagree most on it, degrees. "
        "None where one part alone has it.",
    )

    def doubts(self) -> tuple[str, ...]:
        """What did not join, and seams at which most photos disagree by more than the parts' bounds allow."""
        missing = [f"{one.name} was not joined: {one.why_not}." for one in self.parts if one.why_not]
        if self.photos_left_out:
            missing.append(f"{self.photos_left_out} photos were placed by no part that joined.")
        weak = [
            f"{one.parts[0]} and {one.parts[1]} disagree by {one.rotation_deg:.2g} degrees (median) on {one.photos} "
            "photos that both have, more than their bounds allow."
            for one in self.seams
            if one.within is not None and one.within < WEAK
        ]
        return (*missing, *weak)


class InputAccuracy(FrozenModel):
    """How accurate the input's poses are, measured against the poses that tracks and patches gave.

    Standard deviations of each component of the errors, after alignment. They include the errors of those poses.
    """

    rotation_deg: float = Field(examples=[0.4])
    position: float = Field(examples=[0.03], description="In the input's unit.")
    body_from_camera: tuple[tuple[float, float, float, float], ...] | None = Field(
        None,
        description="Offset between the tracked body (robot hand, phone), or other axes, and the camera that all poses "
        "of the input share, 4 x 4 in the input's unit: given @ body_from_camera are the cameras. Its shift is zero "
        "along directions in which it is not known. None where the errors show none.",
    )
    body_from_camera_deviation: float | None = Field(
        None,
        examples=[0.002],
        description="Standard deviation of its shift along the least certain of the known directions, in the input's "
        "unit. None where no shift is known.",
    )
    body_from_camera_known_along: tuple[tuple[float, float, float], ...] = Field(
        (),
        description="Unit vectors in the axes of the body along which its shift is known, or known to be zero: three "
        "where all of it is, none where only the turn is.",
    )
    stated_rotation_deg: float | None = Field(None, description="As stated by an option; None: not stated.")
    stated_position: float | None = Field(None, description="As stated by an option, in the input's unit.")
