"""transforms.json as nerfstudio, instant-ngp and Blender (NeRF-synthetic) write it, read and checked."""

from __future__ import annotations

import posixpath
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from biresnerf.data.formats.bind_images import ParsedPoses, PoseEntry, dataset_of
from biresnerf.data.formats.colmap.read_model import model_file_formats, read_colmap_model
from biresnerf.data.formats.transforms.read_intrinsics import Fields, camera_of_frame
from biresnerf.data.model.conventions import world_from_cam_of_file
from biresnerf.data.model.dataset import Dataset, SourceFormat
from biresnerf.data.model.pose_validation import ROTATION_WARNED, rigid_matrix
from biresnerf.data.model.untrusted_file import invalid_file, read_json_object
from biresnerf.data.photos.masks import dynamic_mask, named_mask
from biresnerf.data.photos.named_images import (
    find_images,
    refuse_more_than_files,
    refuse_names_outside,
    refuse_too_few,
    unused_image_notes,
)
from biresnerf.errors import InputError

_NGP_KEYS = frozenset(
    {"aabb_scale", "scale", "offset", "is_fisheye", "sharpness", "x_fov", "enable_depth_loading"}
)
# Older nerfstudio turned COLMAP's world by this without writing it into the file.
_OLDER_TRANSFORM = np.array([[0.0, 1, 0, 0], [1, 0, 0, 0], [0, 0, -1, 0], [0, 0, 0, 1]])
_MODEL = "colmap/sparse/0"
# Poses are taken for equal up to this, relative to the largest coordinate: files have 6 digits or more.
_EQUAL = 1e-4
_NERFSTUDIO_KEYS = frozenset({"camera_model", "applied_transform", "ply_file_path", "applied_scale"})


def read_transforms(path: Path, within: Path | None = None) -> Dataset:
    """The validated image set that the transforms file ``path`` describes; of the images, only headers are read.

    Args:
        path: the file.
        within: refuse images outside of this folder; for uploaded sets.

    Raises:
        InputError: with the file, the field and a hint; codes as in docs/input.md.
    """
    return bind_transforms(parse_transforms(path.parent, path), path.parent, within)


def parse_transforms(_root: Path, path: Path) -> ParsedPoses:
    """Names and poses of the frames; a frame that names no image has an empty name. Raises InputError."""
    document = read_json_object(path)
    rows = _frame_objects(document, path.name)
    source = _source_format(document, path)
    entries: list[PoseEntry] = []
    worst, worst_name = 0.0, ""
    for index, row in enumerate(rows):
        where, pose = f"{path.name} frames[{index}]", None
        name = row["file_path"] if isinstance(row.get("file_path"), str) else ""
        if row.get("transform_matrix") is not None:
            matrix, deviation = rigid_matrix(row["transform_matrix"], f"{where}.transform_matrix")
            pose = world_from_cam_of_file(matrix, source.applied_transform, source.applied_scale)
            if deviation > worst:
                worst, worst_name = deviation, name
        lens = partial(camera_of_frame, Fields(row, source.document, path.name, index))
        entries.append(PoseEntry(name, pose, where, lens, _named_size(row, document), raw=row))
    notes: tuple[str, ...] = ()
    if worst > ROTATION_WARNED:
        notes = (f"rotations were made orthonormal; the worst was off by {worst:.1e} ({worst_name})",)
    return ParsedPoses(source, tuple(entries), notes=notes)


def bind_transforms(parsed: ParsedPoses, root: Path, within: Path | None = None) -> Dataset:
    """The dataset of the images that the frames name, with their intrinsics and masks.

    Raises:
        InputError: codes as in docs/input.md.
    """
    path = parsed.source.files[0]
    refuse_too_few(len(parsed.entries), f"{path.name} frames")
    names = _names(parsed.entries)
    if within is not None:
        refuse_more_than_files(path, names, within)
        refuse_names_outside(path, names, within, "file_path")
    paths = find_images(path, names)
    parsed = _with_older_transform(parsed)
    images = [
        (image, replace(entry, mask=_mask(path, entry, image, within)))
        for image, entry in zip(paths, parsed.entries, strict=True)
    ]
    notes = list(parsed.notes)
    if any(
        place.get("rolling_shutter")
        for place in (parsed.source.document, *(row.raw for row in parsed.entries))
    ):
        notes.append("rolling_shutter is not modelled")
    dataset = dataset_of(root, images, parsed.source, notes, within, table="frames")
    masks = [frame.mask for frame in dataset.frames if frame.mask is not None]
    return replace(dataset, warnings=(*dataset.warnings, *unused_image_notes(paths, masks)))


def _named_size(row: dict[str, Any], document: dict[str, Any]) -> tuple[float | None, float | None]:
    """w and h that apply to a frame; None for other than numbers, which `camera_of_frame` refuses."""
    top = {} if row.get("fl_x") is not None else document  # its own focal length goes with its own size
    width, height = (_usable(row.get(key, top.get(key))) for key in ("w", "h"))
    return width, height


def _usable(value: Any) -> float | None:
    return float(value) if isinstance(value, int | float) and 0 < value < 1e12 else None


def _frame_objects(document: dict[str, Any], file: str) -> list[dict[str, Any]]:
    rows = document.get("frames")
    if not isinstance(rows, list):
        hint = "Give a transforms.json as nerfstudio, instant-ngp or Blender write it."
        raise invalid_file(f"{file} frames", "has no list of frames.", hint)
    for index, row in enumerate(rows):
        if not isinstance(row, dict):
            hint = "Give file_path and transform_matrix in each frame."
            raise invalid_file(f"{file} frames[{index}]", "is not an object.", hint)
    return rows


def _source_format(document: dict[str, Any], path: Path) -> SourceFormat:
    applied = document.get("applied_transform")
    matrix, scale = np.eye(4), document.get("applied_scale", 1.0)
    if applied is not None:
        matrix, _ = rigid_matrix(applied, f"{path.name} applied_transform")
    if isinstance(scale, bool) or not isinstance(scale, int | float) or not 1e-9 < scale < 1e9:
        hint = "Remove the key, or give the factor that was applied to the positions."
        raise invalid_file(f"{path.name} applied_scale", "is not a positive number.", hint)
    kept = {key: None if key == "frames" else value for key, value in document.items()}
    return SourceFormat(_dialect(document), path, kept, matrix, float(scale), files=(path,))


def _dialect(document: dict[str, Any]) -> str:
    if document.keys() & _NERFSTUDIO_KEYS:
        return "nerfstudio"
    if document.keys() & _NGP_KEYS:
        return "instant-ngp"
    keys = document.keys() | (document["frames"][0].keys() if document["frames"] else set())
    return "blender" if "camera_angle_x" in document and "fl_x" not in keys else "nerfstudio"


def _with_older_transform(parsed: ParsedPoses) -> ParsedPoses:
    """The same; older nerfstudio's transform is undone where a model beside the file shows it."""
    source, older = parsed.source, None
    if source.dialect == "nerfstudio" and source.document.get("applied_transform") is None:
        older = _older_transform(source.files[0], parsed.entries)
    if older is None:
        return parsed
    note = (
        "applied_transform is not given; colmap/sparse/0 shows that it was older nerfstudio's, so that model's "
        "world is taken for the result's COLMAP model"
    )
    world_from_file = np.linalg.inv(older)
    entries = tuple(
        entry
        if entry.world_from_cam is None
        else replace(entry, world_from_cam=world_from_file @ entry.world_from_cam)
        for entry in parsed.entries
    )
    return ParsedPoses(replace(source, applied_transform=older), entries, notes=(note, *parsed.notes))


def _older_transform(file: Path, entries: Sequence[PoseEntry]) -> NDArray[np.float64] | None:
    """The transform that ``file``, which names none, was made with, where the model beside it shows that it was.

    nerfstudio itself takes this transform as soon as there is a model; here the model's poses must agree with the
    frames' after it, as folders of other programs hold both files, too. None where they do not.
    """
    folder = file.parent / _MODEL
    if not model_file_formats(folder):
        return None
    try:
        images = read_colmap_model(folder).images.values()
    except InputError:
        return None  # not what is read; nothing is taken from it
    by_name = {posixpath.basename(image.name): image.world_from_cam for image in images}
    off, size, found = 0.0, 1.0, 0
    for entry in entries:
        pose = by_name.get(posixpath.basename(entry.name))
        if pose is not None and entry.world_from_cam is not None:
            expected = _OLDER_TRANSFORM @ pose
            found, off = found + 1, max(off, float(np.abs(entry.world_from_cam - expected).max()))
            size = max(size, float(np.abs(expected).max()))
    return _OLDER_TRANSFORM if found and off <= _EQUAL * size else None


def _names(entries: Sequence[PoseEntry]) -> list[str]:
    for entry in entries:
        if not entry.name:
            raise InputError(
                "frame_without_image",
                "the frame names no image.",
                where=f"{entry.where}.file_path",
                hint="Give the image's path relative to this file, or remove the frame.",
            )
    return [entry.name for entry in entries]


def _mask(file: Path, entry: PoseEntry, image: Path, within: Path | None) -> tuple[Path | None, bool]:
    """The frame's own mask, or instant-ngp's beside the image, and whether it is black where pixels count."""
    name = entry.raw.get("mask_path")
    if name is None:
        return dynamic_mask(image, within)
    return named_mask(file, name, f"{entry.where}.mask_path", within), False
