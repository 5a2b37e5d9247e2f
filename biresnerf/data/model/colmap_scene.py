"""A COLMAP model in memory: every id, rig, frame, observation and point as its files have them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from biresnerf.geometry.camera.camera_models import Camera
from biresnerf.geometry.rigid import (
    motion_of,
    quat_wxyz_from_rotation,
    rigid_inverse,
    rotation_from_quat_wxyz,
)

SensorType = Literal["CAMERA", "IMU"]
SENSOR_TYPES: tuple[SensorType, ...] = ("CAMERA", "IMU")  # by COLMAP's numbers
ModelFileFormat = Literal["binary", "text"]
Sensor = tuple[SensorType, int]
NO_POINT = -1  # of an observation that belongs to no 3D point


@dataclass(frozen=True, eq=False)
class RigidPose:
    """``b_from_a`` as COLMAP writes it: a quaternion (w, x, y, z), float64 [4], and a translation, float64 [3].

    The quaternion is kept as it stands in the file; its length is not exactly 1.
    """

    quat_wxyz: NDArray[np.float64]
    translation: NDArray[np.float64]


def rigid_pose_of(b_from_a: NDArray[np.float64]) -> RigidPose:
    """The pose of a matrix [4, 4] as COLMAP writes it; the quaternion's w is not negative."""
    return RigidPose(quat_wxyz_from_rotation(b_from_a[:3, :3]), b_from_a[:3, 3].copy())


def matrix_of_pose(pose: RigidPose) -> NDArray[np.float64]:
    """The matrix [4, 4] of a pose as COLMAP writes it."""
    return motion_of(rotation_from_quat_wxyz(pose.quat_wxyz), pose.translation)


@dataclass(frozen=True, eq=False)
class ColmapImage:
    """One registered image.

    Attributes:
        id, name, camera_id: as in the file; the name is relative to the folder of images, with forward slashes.
        cam_from_world: its pose, OpenCV axes.
        points2d_px: its features, float64 [n, 2], px.
        point3d_ids: the 3D point that each feature sees, int64 [n]; `NO_POINT` where none.
    """

    id: int
    name: str
    camera_id: int
    cam_from_world: RigidPose
    points2d_px: NDArray[np.float64]
    point3d_ids: NDArray[np.int64]

    @property
    def world_from_cam(self) -> NDArray[np.float64]:
        """The pose, float64 [4, 4]."""
        return rigid_inverse(matrix_of_pose(self.cam_from_world))


@dataclass(frozen=True, eq=False)
class ColmapPoints:
    """The 3D points, in the file's order; point k is seen by the track elements starts[k] to starts[k + 1].

    Attributes:
        ids: int64 [m].
        xyz: float64 [m, 3], in the world.
        rgb: uint8 [m, 3].
        errors: mean reprojection error, float64 [m], px; -1 where COLMAP has not computed it.
        track_starts: int64 [m + 1].
        track_image_ids: int64 [k].
        track_point2d_indices: which feature of that image, int64 [k].
    """

    ids: NDArray[np.int64]
    xyz: NDArray[np.float64]
    rgb: NDArray[np.uint8]
    errors: NDArray[np.float64]
    track_starts: NDArray[np.int64]
    track_image_ids: NDArray[np.int64]
    track_point2d_indices: NDArray[np.int64]

    def __len__(self) -> int:
        return len(self.ids)

    @property
    def owner(self) -> NDArray[np.int64]:
        """The row of the point that each track element is of, int64 [k]."""
        return np.repeat(np.arange(len(self)), np.diff(self.track_starts))

    def only(self, points: NDArray[np.bool_], elements: NDArray[np.bool_]) -> ColmapPoints:
        """These points [m] alone, with these elements [k] of their tracks alone."""
        lengths = np.bincount(self.owner[elements], minlength=len(self))[points]
        return ColmapPoints(
            self.ids[points],
            self.xyz[points],
            self.rgb[points],
            self.errors[points],
            np.concatenate([np.zeros(1, np.int64), np.cumsum(lengths)]),
            self.track_image_ids[elements],
            self.track_point2d_indices[elements],
        )


def no_points() -> ColmapPoints:
    """The points of a model that has none."""
    none = np.zeros(0, np.int64)
    return ColmapPoints(
        none, np.zeros((0, 3)), np.zeros((0, 3), np.uint8), np.zeros(0), np.zeros(1, np.int64), none, none
    )


@dataclass(frozen=True, eq=False)
class ColmapRig:
    """Sensors bolted together. ``sensor_from_rig`` has all but the reference; None where it is not known."""

    id: int
    reference: Sensor | None
    sensor_from_rig: dict[Sensor, RigidPose | None]


@dataclass(frozen=True, eq=False)
class ColmapFrame:
    """One moment of a rig: its pose, and what each sensor took (for a camera the image's id)."""

    id: int
    rig_id: int
    rig_from_world: RigidPose
    data_ids: tuple[tuple[Sensor, int], ...]


@dataclass(frozen=True, eq=False)
class ColmapModel:
    """A validated model: no dangling reference, no repeated id or name, all numbers finite.

    Attributes:
        folder: where it was read.
        file_format: which of the two was read.
        cameras: by id, in the file's order.
        images: by id, in the file's order.
        points: the 3D points.
        rigs, frames: by id; both empty in models from before COLMAP 3.12.
        notes: what the user should know about how it was read.
    """

    folder: Path
    file_format: ModelFileFormat
    cameras: dict[int, Camera]
    images: dict[int, ColmapImage]
    points: ColmapPoints
    rigs: dict[int, ColmapRig]
    frames: dict[int, ColmapFrame]
    notes: tuple[str, ...] = ()

    @property
    def tables(self) -> tuple[str, ...]:
        """The names of the model's files, without suffix. points3D is written even without points: readers need it."""
        return ("points3D", "cameras", "images", *(("rigs", "frames") if self.rigs else ()))
