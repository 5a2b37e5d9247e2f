"""A COLMAP model (sparse/0) read strictly, without COLMAP: binary or text, with or without rigs and frames.

pycolmap takes truncated files and zero quaternions in silence and allocates whatever a count says; here every
such file is refused, at once, by an error that says what is wrong with it.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from biresnerf.data.formats.colmap.model_checks import broken, check_images, check_rigs, check_tracks
from biresnerf.data.formats.colmap.read_tables import READERS, BinaryTable, TextTable
from biresnerf.data.model import colmap_scene as colmap
from biresnerf.data.model.untrusted_file import read_bytes, read_text
from biresnerf.geometry.camera.camera_models import Camera

MAX_TABLE_BYTES = 2 * 2**30
_SUFFIXES: dict[colmap.ModelFileFormat, str] = {"binary": ".bin", "text": ".txt"}
# An image's pose by images.bin and by frames.bin are the same motion, up to this much: radians, and the share of
# the distance.
_SAME_POSE = 1e-3


def model_file_formats(folder: Path) -> tuple[colmap.ModelFileFormat, ...]:
    """The file formats in which ``folder`` holds a model, binary first, as COLMAP reads them."""
    return tuple(
        file_format
        for file_format, suffix in _SUFFIXES.items()
        if (folder / f"cameras{suffix}").is_file() and (folder / f"images{suffix}").is_file()
    )


def image_count(folder: Path) -> int:
    """How many images the model in ``folder`` has, by the beginning of its table or the number of its lines."""
    found = model_file_formats(folder)
    if not found:
        return 0
    with (folder / f"images{_SUFFIXES[found[0]]}").open("rb") as file:
        if found[0] == "binary":
            return int.from_bytes(file.read(8), "little")
        return (1 + sum(not line.startswith(b"#") for line in file)) // 2


def read_colmap_model(folder: Path) -> colmap.ColmapModel:
    """The model in ``folder``; binary where it holds both file formats, and a note says so.

    Raises:
        InputError: with the file and the id, line or byte; codes as in docs/input.md.
    """
    found = model_file_formats(folder)
    if not found:
        raise broken(
            folder.name, "holds no COLMAP model", "input_missing", "Give cameras.bin and images.bin."
        )
    file_format = found[0]
    tables = _Tables(folder, file_format)
    notes = [f"the binary model in {folder.name} was read and the text model beside it was not"]
    notes = notes if len(found) > 1 else []
    cameras: dict[int, Camera] = tables.read("cameras")
    images: dict[int, colmap.ColmapImage] = tables.read("images")
    points: colmap.ColmapPoints | None = tables.read("points3D")
    rigs: dict[int, colmap.ColmapRig] | None = tables.read("rigs")
    frames: dict[int, colmap.ColmapFrame] | None = tables.read("frames")
    check_images(images, cameras, tables.file("images"))
    if points is None:
        notes.append(f"{tables.file('points3D')} is missing: the model is taken without points")
        points, images = (
            colmap.no_points(),
            {number: _without_observations(image) for number, image in images.items()},
        )
    check_tracks(images, points, tables.file("points3D"))
    if (rigs is None) != (frames is None):
        there, lacking = ("frames", "rigs") if rigs is None else ("rigs", "frames")
        raise broken(tables.file(there), f"there is no {tables.file(lacking)} beside it")
    rigs, frames = rigs or {}, frames or {}
    if rigs or frames:
        check_rigs(rigs, frames, cameras, images, tables.file("frames"))
        images, moved = _with_poses_of_frames(rigs, frames, images)
        if moved:
            notes.append(
                f"{tables.file('images')} and {tables.file('frames')} have different poses for {len(moved)} "
                f"images ({moved[0]}, ...); the frames' were taken, as COLMAP does"
            )
    return colmap.ColmapModel(folder, file_format, cameras, images, points, rigs, frames, tuple(notes))


class _Tables:
    """The files of a model in one file format."""

    def __init__(self, folder: Path, file_format: colmap.ModelFileFormat) -> None:
        self.folder, self.file_format = folder, file_format

    def file(self, table: str) -> str:
        return table + _SUFFIXES[self.file_format]

    def read(self, table: str) -> Any:
        """The parsed table, or None where there is no such file."""
        path = self.folder / self.file(table)
        if not path.is_file():
            return None
        if self.file_format == "binary":
            return READERS[table](BinaryTable(read_bytes(path, MAX_TABLE_BYTES), path.name))
        return READERS[table](TextTable(read_text(path, MAX_TABLE_BYTES), path.name))


def _without_observations(image: colmap.ColmapImage) -> colmap.ColmapImage:
    return replace(image, point3d_ids=np.full(len(image.point3d_ids), colmap.NO_POINT))


def _with_poses_of_frames(
    rigs: dict[int, colmap.ColmapRig],
    frames: dict[int, colmap.ColmapFrame],
    images: dict[int, colmap.ColmapImage],
) -> tuple[dict[int, colmap.ColmapImage], list[str]]:
    """The images with their frame's pose where their own is another; and the names of these."""
    images, moved = dict(images), []
    for frame in frames.values():
        rig = rigs[frame.rig_id]
        for sensor, data_id in frame.data_ids:
            if sensor[0] != "CAMERA":
                continue
            cam_from_world = frame.rig_from_world
            if sensor != rig.reference:
                cam_from_rig = rig.sensor_from_rig[sensor]
                if cam_from_rig is None:
                    continue
                cam_from_world = colmap.rigid_pose_of(
                    colmap.matrix_of_pose(cam_from_rig) @ colmap.matrix_of_pose(cam_from_world)
                )
            if not _same(cam_from_world, images[data_id].cam_from_world):
                images[data_id] = replace(images[data_id], cam_from_world=cam_from_world)
                moved.append(images[data_id].name)
    return images, moved


def _same(one: colmap.RigidPose, other: colmap.RigidPose) -> bool:
    unit, unit_other = (pose.quat_wxyz / np.linalg.norm(pose.quat_wxyz) for pose in (one, other))
    turned = 2.0 * min(np.linalg.norm(unit - unit_other), np.linalg.norm(unit + unit_other))
    far = max(1.0, float(np.linalg.norm(one.translation)))
    return bool(
        turned < _SAME_POSE and np.linalg.norm(one.translation - other.translation) < _SAME_POSE * far
    )
