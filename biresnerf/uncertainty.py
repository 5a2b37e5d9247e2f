"""What a result says of how exact poses are, and GPS. No torch: the service reads it too."""

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


class GeoReference(FrozenModel, allow_inf_nan=False):
    """Where on Earth the poses are: x points east, y north and z up, in metres, from a place given in WGS84."""

    latitude: float = Field(examples=[50.0874], description="Degrees, north above zero.")
    longitude: float = Field(examples=[14.4213], description="Degrees, east above zero.")
    altitude: float = Field(examples=[195.0], description="Metres, as the photos have it.")
    images: int = Field(examples=[48], description="How many photos with a GPS position this rests on.")
    residual_m: float = Field(
        examples=[2.1], description="Median distance of a camera from its GPS position."
    )


class InputAccuracy(FrozenModel):
    """How accurate the input's poses are, measured against the poses that tracks and patches gave.

    Standard deviations of each component of the errors, after alignment. The errors of the other poses are in them.
    """

    rotation_deg: float = Field(examples=[0.4])
    position: float = Field(examples=[0.03], description="In the input's unit.")
    body_from_camera: tuple[tuple[float, float, float, float], ...] | None = Field(
        None,
        description="Offset between the tracked body (robot hand, phone) and the camera that all poses of the input "
        "share, 4 x 4 in the input's unit. None where the errors show none.",
    )
    stated_rotation_deg: float | None = Field(None, description="As stated by an option; None: not stated.")
    stated_position: float | None = Field(None, description="As stated by an option, in the input's unit.")
