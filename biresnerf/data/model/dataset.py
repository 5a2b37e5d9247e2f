"""An image set in memory: cameras, frames and how the input was written. Frozen, numpy only."""

from __future__ import annotations

import os
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from biresnerf.data.model.colmap_scene import ColmapModel
from biresnerf.data.model.measured_places import ControlPoints, PositionPriors
from biresnerf.errors import Fault
from biresnerf.geometry.body_offset import BodyOffset
from biresnerf.geometry.camera.camera_models import Camera
from biresnerf.report import IntrinsicsSource, PoseSource

# Guesses from other images: worth trying, not worth believing.
GUESSES: frozenset[PoseSource] = frozenset({"neighbours", "nearest-view"})


@dataclass(frozen=True, eq=False)
class Frame:
    """One image and its pose.

    Attributes:
        name: exactly what the user's file calls the image, or its path relative to the folder of images.
        path: the image file.
        camera: index into ``Dataset.cameras``.
        world_from_cam: float64 [4, 4], a rigid motion; OpenCV axes (x right, y down, z forward). None where
            it is not known yet.
        pose_source: who found the pose; None where there is none.
        raw: the frame as the user's file has it (empty for a folder of images).
        mask: a file that says which pixels count: where it is black they do not.
        orientation: EXIF orientation (1 to 8) by which stored pixels are turned first; camera, pose and mask are
            for the turned picture. 1 where they are for pixels as stored.
        mask_inverted: the mask means the opposite: pixels count where it is black (instant-ngp's dynamic_mask_*).
        timestamp_s: when it was taken, if a trajectory gave the time.
        levels: black and white of a 16-bit photo of a set that uses a small part of them; None: the full range.
    """

    name: str
    path: Path
    camera: int
    world_from_cam: NDArray[np.float64] | None
    pose_source: PoseSource | None
    raw: dict[str, Any] = field(default_factory=dict)
    mask: Path | None = None
    orientation: int = 1
    mask_inverted: bool = False
    timestamp_s: float | None = None
    levels: tuple[int, int] | None = None


@dataclass(frozen=True, eq=False)
class SourceFormat:
    """How the input was written, so that the result can be written the same way.

    Attributes:
        dialect: the format's name; for a transforms.json ``nerfstudio``, ``instant-ngp`` or ``blender``; for a
            trajectory ``tum`` or ``kitti``; for a folder without poses ``images``.
        file: the transforms file, or None for other inputs.
        document: its top-level values other than ``frames``, in their order; and the place of ``frames`` kept
            as a None.
        applied_transform: float64 [4, 4] rigid motion of nerfstudio's key, identity where there is none.
        applied_scale: nerfstudio's key, 1 where there is none. A point of the world lies in the file at
            ``applied_scale * (applied_transform @ x)``.
        colmap: the model that the input was, with its ids, rigs and points; ``Frame.name`` is then its name of the
            image. None for other inputs.
        files: all files but images and masks that were read.
    """

    dialect: str
    file: Path | None = None
    document: dict[str, Any] = field(default_factory=dict)
    applied_transform: NDArray[np.float64] = field(default_factory=lambda: np.eye(4))
    applied_scale: float = 1.0
    colmap: ColmapModel | None = None
    files: tuple[Path, ...] = ()


@dataclass(frozen=True, eq=False)
class Dataset:
    """A validated set of images with poses, or with some or all of them still to be found.

    Attributes:
        root: the folder that image names are relative to.
        cameras: the intrinsics that frames refer to.
        frames: in the user's order.
        source: how the input was written.
        warnings: what the user should know about how it was read.
        intrinsics_sources: who found each camera's intrinsics; empty where the user gave them all.
        faults: what failed on our side, so that evidence is missing that the photos may hold.
        body_offset: the offset that all given poses shared and that was removed; None where none was found.
        positions: where the photos were taken, once looked up; None where it is unknown.
        control: measured points on the ground, once looked up; None where there are none.
        cut: where frames are views of panoramas; None where there are none.
    """

    root: Path
    cameras: tuple[Camera, ...]
    frames: tuple[Frame, ...]
    source: SourceFormat
    warnings: tuple[str, ...] = ()
    intrinsics_sources: tuple[IntrinsicsSource, ...] = ()
    faults: tuple[Fault, ...] = ()
    body_offset: BodyOffset | None = None
    positions: PositionPriors | None = None
    control: ControlPoints | None = None
    cut: Cut | None = None

    def __post_init__(self) -> None:
        if all(by == "given" for by in self.intrinsics_sources):
            object.__setattr__(self, "intrinsics_sources", ())

    def __len__(self) -> int:
        return len(self.frames)

    @property
    def names(self) -> tuple[str, ...]:
        """The images' names as the user's file writes them, in its order."""
        return tuple(frame.name for frame in self.frames)

    @property
    def file_names(self) -> tuple[str, ...]:
        """The images' paths relative to ``root``, with extension and forward slashes (COLMAP's names)."""
        return tuple(Path(os.path.relpath(frame.path, self.root)).as_posix() for frame in self.frames)

    def called(self, name: str) -> list[int]:
        """The frames of this name: the input's name, or the path relative to its root.

        For the name of a panorama, all its views. Empty where there is no such image.
        """
        if name in self._row_of:
            return [self._row_of[name]]
        if self.cut is None:
            return []
        return np.flatnonzero(np.isin(self.cut.rows, self.cut.whole.called(name))).tolist()

    @cached_property
    def _row_of(self) -> dict[str, int]:
        return {name: i for names in (self.file_names, self.names) for i, name in enumerate(names)}

    @property
    def posed(self) -> NDArray[np.bool_]:
        """Which frames have a pose, bool [n]."""
        return np.array([frame.world_from_cam is not None for frame in self.frames], dtype=np.bool_)

    @property
    def world_from_cam(self) -> NDArray[np.float64]:
        """All poses, float64 [n, 4, 4]. Raises ValueError while one is missing."""
        poses = [frame.world_from_cam for frame in self.frames if frame.world_from_cam is not None]
        if len(poses) != len(self.frames):
            raise ValueError(f"{len(self.frames) - len(poses)} of {len(self.frames)} frames have no pose yet")
        return np.stack(poses)

    @property
    def anchors(self) -> NDArray[np.bool_]:
        """Frames that fix the world frame, bool [n]: those with given poses, or without any all but guesses."""
        given = np.array([frame.pose_source == "given" for frame in self.frames], dtype=np.bool_)
        if given.any():
            return given
        found = np.array([frame.pose_source not in GUESSES for frame in self.frames], dtype=np.bool_)
        return found if found.any() else ~found

    def camera_of(self, index: int) -> Camera:
        """The camera of frame ``index``, at full size."""
        return self.cameras[self.frames[index].camera]

    def source_of_intrinsics(self, camera: int) -> IntrinsicsSource:
        """Who found the intrinsics of camera ``camera``."""
        return self.intrinsics_sources[camera] if self.intrinsics_sources else "given"


@dataclass(frozen=True, eq=False)
class Cut:
    """What a set was before its panoramas were cut into views.

    Attributes:
        whole: the set with its panoramas.
        rows: int64 [n], the frame of ``whole`` that each frame shows a part, or all, of.
        cam_from_whole: float64 [n, 4, 4], from that one's axes to the frame's; a rotation.
    """

    whole: Dataset
    rows: NDArray[np.int64]
    cam_from_whole: NDArray[np.float64]

    @property
    def firsts(self) -> NDArray[np.int64]:
        """For each frame of ``whole``, int64 [m], the first of the frames that show it."""
        return np.unique(self.rows, return_index=True)[1]

    def poses_of_whole(self, world_from_cam: NDArray[np.float64]) -> NDArray[np.float64]:
        """Poses [m, 4, 4] of the frames of ``whole``, from those [n, 4, 4] of all frames."""
        poses = world_from_cam @ self.cam_from_whole
        # Where nothing moved, the very numbers that were given.
        return np.stack(
            [
                given
                if (given := frame.world_from_cam) is not None
                and np.array_equal(given @ self.cam_from_whole[first].T, world_from_cam[first])
                else poses[first]
                for frame, first in zip(self.whole.frames, self.firsts, strict=True)
            ]
        )

    def poses_of_views(self, world_from_whole: NDArray[np.float64]) -> NDArray[np.float64]:
        """Poses [n, 4, 4] of the frames from those [m, 4, 4] of the frames of ``whole``."""
        return world_from_whole[self.rows] @ self.cam_from_whole.swapaxes(1, 2)
