"""transforms.json as nerfstudio, instant-ngp and Blender (NeRF-synthetic) write it, read and checked."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from biresnerf.data.formats.bind_images import ParsedPoses, PoseEntry
from biresnerf.data.formats.transforms.older_nerfstudio import applied_transform_left_out
from biresnerf.data.formats.transforms.read_intrinsics import Fields, camera_of_frame
from biresnerf.data.model.camera import Camera
from biresnerf.data.model.conventions import world_from_cam_of_file
from biresnerf.data.model.dataset import Dataset, Frame, SourceFormat
from biresnerf.data.model.json_document import read_json_object
from biresnerf.data.model.pose_validation import ROTATION_WARNED, refuse_coinciding, rigid_matrix
from biresnerf.data.photos.image_files import ImageHeader, read_header
from biresnerf.data.photos.mask_files import dynamic_mask, named_mask
from biresnerf.data.photos.named_images import (
    few_names,
    find_images,
    refuse_names_outside,
    refuse_too_few,
    unused_image_notes,
)
from biresnerf.data.photos.orientation import meant_orientations, orientation_notes, page_notes, turned_header
from biresnerf.errors import InputError
from biresnerf.report import IntrinsicsSource

_NGP_KEYS = frozenset(
    {"aabb_scale", "scale", "offset", "is_fisheye", "sharpness", "x_fov", "enable_depth_loading"}
)
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
        entries.append(PoseEntry(name, pose, where, raw=row))
    notes: tuple[str, ...] = ()
    if worst > ROTATION_WARNED:
        notes = (f"rotations were made orthonormal; the worst was off by {worst:.1e} ({worst_name})",)
    return ParsedPoses(source, tuple(entries), notes=notes)


def bind_transforms(parsed: ParsedPoses, root: Path, within: Path | None = None) -> Dataset:
    """The dataset of the images that the frames name, with their intrinsics and masks.

    Raises:
        InputError: codes as in docs/input.md.
    """
    path = parsed.source.file
    assert path is not None, "parse_transforms gives it"
    rows = [entry.raw for entry in parsed.entries]
    refuse_too_few(len(rows), f"{path.name} frames")
    names = _names(parsed.entries)
    if within is not None:
        refuse_names_outside(path, names, within, "file_path")
    paths = find_images(path, names)
    source, poses, notes = _with_older_transform(parsed, rows)
    stored = [read_header(image, name) for image, name in zip(paths, names, strict=True)]
    sizes = [_named_size(row, source.document) for row in rows]
    orientations = meant_orientations(stored, sizes)
    headers = [turned_header(header, o) for header, o in zip(stored, orientations, strict=True)]
    cameras, sources, camera_indices, more = _cameras(rows, source, headers, names, path.name)
    refuse_coinciding([pose for pose in poses if pose is not None], f"{path.name} frames")
    masks = _masks(path, rows, paths, within)
    notes += [*more, *parsed.notes, *_pose_notes(poses, names)]
    notes += orientation_notes(stored, orientations, names) + page_notes(stored, names)
    notes += _other_notes(rows, source.document, masks)
    notes += unused_image_notes(paths, [mask for mask, _ in masks if mask is not None])
    frames = tuple(
        Frame(
            name, paths[i], camera_indices[i], poses[i], "given" if poses[i] is not None else None, rows[i],
            mask=masks[i][0], mask_inverted=masks[i][1], orientation=orientations[i],
        )
        for i, name in enumerate(names)
    )  # fmt: skip
    return Dataset(root, cameras, frames, source, tuple(notes), sources)


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
        raise _invalid(f"{file} frames", "has no list of frames.", hint)
    for index, row in enumerate(rows):
        if not isinstance(row, dict):
            hint = "Give file_path and transform_matrix in each frame."
            raise _invalid(f"{file} frames[{index}]", "is not an object.", hint)
    return rows


def _invalid(where: str, what: str, hint: str) -> InputError:
    return InputError("pose_file_invalid", what, where=where, hint=hint)


def _source_format(document: dict[str, Any], path: Path) -> SourceFormat:
    applied = document.get("applied_transform")
    matrix, scale = np.eye(4), document.get("applied_scale", 1.0)
    if applied is not None:
        matrix, _ = rigid_matrix(applied, f"{path.name} applied_transform")
    if isinstance(scale, bool) or not isinstance(scale, int | float) or not 1e-9 < scale < 1e9:
        hint = "Remove the key, or give the factor that was applied to the positions."
        raise _invalid(f"{path.name} applied_scale", "is not a positive number.", hint)
    kept = {key: None if key == "frames" else value for key, value in document.items()}
    return SourceFormat(_dialect(document), path, kept, matrix, float(scale), files=(path,))


def _dialect(document: dict[str, Any]) -> str:
    if document.keys() & _NERFSTUDIO_KEYS:
        return "nerfstudio"
    if document.keys() & _NGP_KEYS:
        return "instant-ngp"
    keys = document.keys() | (document["frames"][0].keys() if document["frames"] else set())
    return "blender" if "camera_angle_x" in document and "fl_x" not in keys else "nerfstudio"


def _with_older_transform(
    parsed: ParsedPoses, rows: list[dict[str, Any]]
) -> tuple[SourceFormat, list[NDArray[np.float64] | None], list[str]]:
    """Source, poses and notes; older nerfstudio's transform is undone where a model beside the file shows it."""
    source, poses = parsed.source, [entry.world_from_cam for entry in parsed.entries]
    assert source.file is not None, "parse_transforms gives it"
    older = None
    if source.dialect == "nerfstudio" and source.document.get("applied_transform") is None:
        older = applied_transform_left_out(source.file, rows)
    if older is None:
        return source, poses, []
    note = (
        "applied_transform is not given; colmap/sparse/0 shows that it was older nerfstudio's, so that model's "
        "world is taken for the result's COLMAP model"
    )
    world_from_file = np.linalg.inv(older)
    poses = [None if pose is None else world_from_file @ pose for pose in poses]
    return replace(source, applied_transform=older), poses, [note]


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


def _cameras(
    rows: list[dict[str, Any]], source: SourceFormat, headers: list[ImageHeader], names: list[str], file: str
) -> tuple[tuple[Camera, ...], tuple[IntrinsicsSource, ...], list[int], list[str]]:
    """The cameras, who found each (empty where the file gives all), each frame's, and notes."""
    cameras: dict[tuple[Camera, IntrinsicsSource], int] = {}
    shared_sizes: dict[tuple[int, int], int] = {}
    indices: list[int] = []
    notes: dict[str, None] = {}
    for index, (row, header, name) in enumerate(zip(rows, headers, names, strict=True)):
        result = camera_of_frame(Fields(row, source.document, file, index), header, name)
        if result.shared:
            shared_sizes.setdefault((header.width, header.height), index)
        indices.append(cameras.setdefault((result.camera, result.source), len(cameras)))
        notes.update(dict.fromkeys(result.notes))
    if len(shared_sizes) > 1:
        (size_a, a), (size_b, b) = list(shared_sizes.items())[:2]
        raise InputError(
            "mixed_sizes",
            f"{names[a]} has {size_a[0]} x {size_a[1]} px, {names[b]} {size_b[0]} x {size_b[1]} px, "
            "but the intrinsics are shared.",
            where=f"{file} frames[{b}]",
            hint="Give each frame its own fl_x, fl_y, cx, cy, w and h, or images of one size.",
        )
    sources = tuple(by for _, by in cameras)
    return tuple(camera for camera, _ in cameras), sources, indices, list(notes)


def _pose_notes(poses: Sequence[NDArray[np.float64] | None], names: Sequence[str]) -> list[str]:
    without = [name for name, pose in zip(names, poses, strict=True) if pose is None]
    return (
        [f"{len(without)} of {len(names)} frames have no pose yet: {few_names(without)}"] if without else []
    )


def _masks(
    path: Path, rows: list[dict[str, Any]], images: Sequence[Path], within: Path | None
) -> list[tuple[Path | None, bool]]:
    """Each frame's mask, its own or instant-ngp's beside the image, and whether it is black where pixels count."""
    masks = []
    for index, (row, image) in enumerate(zip(rows, images, strict=True)):
        name = row.get("mask_path")
        where = f"{path.name} frames[{index}].mask_path"
        if name is None:
            masks.append(dynamic_mask(image, within))
        else:
            masks.append((named_mask(path, name, where, within), False))
    return masks


def _other_notes(
    rows: list[dict[str, Any]], document: dict[str, Any], masks: list[tuple[Path | None, bool]]
) -> list[str]:
    notes = []
    masked = sum(mask is not None for mask, _ in masks)
    if masked:
        notes.append(f"masks were found for {masked} of {len(rows)} images")
    if any(row.get("rolling_shutter") or document.get("rolling_shutter") for row in rows):
        notes.append("rolling_shutter is not modelled")
    return notes
