"""``poses.json``: every image's pose before and after, how exact it is, its lens and flags, in our own format.

With the COLMAP model it loses nothing, so the other formats of a result can be made from the two later.
"""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from biresnerf.data.formats.codec import Codec
from biresnerf.data.model.atomic_file import write_json
from biresnerf.data.model.refined_set import PointsSource, RefinedSet
from biresnerf.data.model.untrusted_file import checked, read_json_object
from biresnerf.frozen_model import FrozenModel
from biresnerf.geometry.body_offset import BodyOffset
from biresnerf.geometry.camera.camera_models import Camera
from biresnerf.options.formats import Format
from biresnerf.report import SimilarityReport
from biresnerf.uncertainty import PoseUncertainty

POSES_JSON = Format(
    name="poses",
    title="poses.json",
    rank=90,
    in_set="poses.json",
    always=True,
    loses=("rigs", "points"),
    heading="For your own programs",
    hint="Each pose before and after, in full precision",
)

POSES = POSES_JSON.in_result
AXES = (
    "world_from_cam and cam_from_world are [R | t] with OpenCV axes (x right, y down, z forward), in the input's "
    "world; the centre of the first pixel is (0.5, 0.5)"
)

Row = tuple[float, float, float, float]
Matrix = tuple[Row, Row, Row]


class PoseImage(FrozenModel, allow_inf_nan=False):
    """One image. Poses are the upper three rows of 4 x 4 matrices."""

    name: str = Field(description="As the input writes it.")
    file_name: str = Field(description="Path relative to the input's folder, with extension.")
    camera: int = Field(description="Index into cameras.")
    orientation: int = Field(
        1,
        description="EXIF orientation that stored pixels are turned by first; camera and poses are for the result.",
    )
    cam_from_world: Matrix
    world_from_cam: Matrix = Field(description="The inverse: its last column is the camera's centre.")
    world_from_cam_before: Matrix | None = Field(description="As given; null where no pose was.")
    pose_source: str
    flags: tuple[str, ...]
    uncertainty: PoseUncertainty | None = Field(
        None, description="Of world_from_cam; null where nothing was said of it."
    )


class BodyFromCamera(FrozenModel, allow_inf_nan=False):
    """How the camera sits on the body (robot's flange, phone) whose poses the input had."""

    matrix: Matrix = Field(
        description="In the input's unit: world_from_cam @ inverse(matrix) are the poses of the body. Its shift is "
        "zero along directions in which it is not known."
    )
    shift_deviation: float | None = Field(
        description="Standard deviation along the least certain of the known directions; null where there are none."
    )
    known_along: tuple[tuple[float, float, float], ...] = Field(
        description="Directions in which the shift is known, or known to be zero: unit vectors in the body's axes."
    )


class PosesDocument(FrozenModel, allow_inf_nan=False):
    """The whole file."""

    format: Literal["biresnerf-poses"] = "biresnerf-poses"
    version: Literal[1] = 1
    axes: str = AXES
    cameras: tuple[Camera, ...]
    images: tuple[PoseImage, ...]
    input_from_optimised: SimilarityReport
    points_source: PointsSource
    timestamps_s: tuple[float, ...] | None = None
    body_from_camera: BodyFromCamera | None = Field(
        None, description="Null where no offset was found that these poses have."
    )


def write_poses_json(refined: RefinedSet, path: Path) -> None:
    """Writes the file, whole or not at all; numbers with all their digits."""
    images = tuple(
        PoseImage(
            name=image.name,
            file_name=image.file_name,
            camera=image.camera,
            orientation=image.orientation,
            cam_from_world=_rows(cam_from_world),
            world_from_cam=_rows(image.world_from_cam),
            world_from_cam_before=None if image.given is None else _rows(image.given),
            pose_source=image.pose_source,
            flags=image.flags,
            uncertainty=image.uncertainty,
        )
        for image, cam_from_world in zip(refined.images, refined.cam_from_world, strict=True)
    )
    document = PosesDocument(
        cameras=refined.cameras,
        images=images,
        input_from_optimised=refined.similarity.report(),
        points_source=refined.points_source,
        timestamps_s=refined.timestamps_s,
        body_from_camera=_body_from_camera(refined.body_offset),
    )
    write_json(path, document.model_dump(), indent=1)


def read_poses_json(path: Path) -> PosesDocument:
    """The file, checked.

    Raises:
        InputError: ``pose_file_invalid``, or a code of `read_json_object`.
    """
    hint = "Give the poses.json of a finished result, as it was written."
    return checked(PosesDocument, read_json_object(path), path.name, hint, "pose_file_invalid")


def body_offset_of(document: PosesDocument) -> BodyOffset | None:
    """The offset that the file holds."""
    known = document.body_from_camera
    if known is None:
        return None
    along = np.array(known.known_along, np.float64).reshape(-1, 3).T
    return BodyOffset(matrix_of(known.matrix), known.shift_deviation, along)


def _body_from_camera(offset: BodyOffset | None) -> BodyFromCamera | None:
    if offset is None:
        return None
    return BodyFromCamera(
        matrix=_rows(offset.body_from_cam),
        shift_deviation=offset.shift_deviation,
        known_along=tuple((x, y, z) for x, y, z in offset.known_along.T.tolist()),
    )


def matrix_of(rows: Matrix) -> NDArray[np.float64]:
    """The 4 x 4 matrix of a file's three rows."""
    return np.array([*rows, (0.0, 0.0, 0.0, 1.0)])


def _rows(matrix: NDArray[np.float64]) -> Matrix:
    a, b, c = (tuple(float(value) for value in row) for row in matrix[:3])
    return a, b, c  # type: ignore[return-value]


CODECS = (Codec(POSES_JSON, write=lambda refined, path, _: write_poses_json(refined, path)),)
