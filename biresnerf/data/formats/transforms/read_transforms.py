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

from biresnerf.data.formats.bad_frames import attempt, good_frames
from biresnerf.data.formats.bind_images import dataset_of
from biresnerf.data.formats.colmap.read_model import model_file_formats, read_colmap_model
from biresnerf.data.formats.parsed_poses import ParsedPoses, PoseEntry, without_problems
from biresnerf.data.formats.transforms.dialects import plain_document
from biresnerf.data.formats.transforms.find_photos import find_photos
from biresnerf.data.formats.transforms.read_intrinsics import Fields, camera_of_frame
from biresnerf.data.model.conventions import world_from_cam_of_file
from biresnerf.data.model.dataset import Dataset, SourceFormat
from biresnerf.data.model.pose_validation import ROTATION_WARNED, rigid_matrix
from biresnerf.data.model.untrusted_file import invalid_file, read_json, refuse_non_finite
from biresnerf.data.photos.masks import dynamic_mask, named_mask
from biresnerf.data.photos.named_images import refuse_more_than_files, refuse_too_few
from biresnerf.data.photos.photo_folders import unused_image_notes
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
    if within is not None:
        refuse_frames_without_files(path, within)
    return bind_transforms(without_problems(parse_transforms(path.parent, path)), path.parent, within)


def refuse_frames_without_files(path: Path, within: Path) -> None:
    """Raises InputError ``image_missing`` where most frames have no file, before their poses are looked at."""
    document = read_json(path, apart="frames")
    frames = document.get("frames") if isinstance(document, dict) else document
    if isinstance(frames, list):
        refuse_more_than_files(f"{path.name} frames", len(frames), within)


def parse_transforms(_root: Path, path: Path) -> ParsedPoses:
    """Names and poses of the frames; a frame that names no image has an empty name. Raises InputError."""
    document, notes = plain_document(path)
    rows = _frame_objects(document, path.name)
    source = _source_format(document, path)
    entries: list[PoseEntry] = []
    worst, worst_name = 0.0, ""
    for index, row in enumerate(rows):
        where, pose, problem = f"{path.name} frames[{index}]", None, None
        name = row["file_path"] if isinstance(row.get("file_path"), str) else ""
        if row.get("transform_matrix") is not None:
            try:
                refuse_non_finite(row, path.name, f"frames[{index}]")
                matrix, deviation = rigid_matrix(row["transform_matrix"], f"{where}.transform_matrix")
            except InputError as error:
                problem = error
            else:
                pose = world_from_cam_of_file(matrix, source.applied_transform, source.applied_scale)
                if deviation > worst:
                    worst, worst_name = deviation, name
        lens = partial(camera_of_frame, Fields(row, source.document, path.name, index))
        size = _named_size(row, document)
        entries.append(PoseEntry(name, pose, where, lens, size, raw=row, problem=problem))
    if worst > ROTATION_WARNED:
        notes.append(f"rotations were made orthonormal; the worst was off by {worst:.1e} ({worst_name})")
    return ParsedPoses(source, tuple(entries), notes=tuple(notes))


def bind_transforms(parsed: ParsedPoses, root: Path, within: Path | None = None) -> Dataset:
    """The dataset of the images that the frames name, with their intrinsics and masks."""
    path = parsed.source.files[0]
    refuse_too_few(len(parsed.entries), f"{path.name} frames")
    pairs, found = find_photos(path, root, parsed.entries, within, strict=parsed.strict)
    parsed = _with_older_transform(replace(parsed, entries=tuple(entry for _, entry in pairs)))
    masked = [
        attempt(partial(_with_mask, path, entry, image, within))
        for (image, _), entry in zip(pairs, parsed.entries, strict=True)
    ]
    images, _, lacking = good_frames(masked, [entry.name for _, entry in pairs], strict=parsed.strict)
    notes = [*parsed.notes, *found, *lacking]
    if any(
        place.get("rolling_shutter")
        for place in (parsed.source.document, *(row.raw for row in parsed.entries))
    ):
        notes.append("rolling_shutter is not modelled")
    dataset = dataset_of(root, images, parsed.source, notes, within, table="frames", strict=parsed.strict)
    masks = [frame.mask for frame in dataset.frames if frame.mask is not None]
    return replace(
        dataset, warnings=(*dataset.warnings, *unused_image_notes([image for image, _ in images], masks))
    )


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
    source = replace(source, applied_transform=older)
    return replace(parsed, source=source, entries=entries, notes=(note, *parsed.notes))


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


def _with_mask(file: Path, entry: PoseEntry, image: Path, within: Path | None) -> tuple[Path, PoseEntry]:
    """The image and its entry with the frame's own mask, or with instant-ngp's beside the image."""
    name = entry.raw.get("mask_path")
    if name is None:
        return image, replace(entry, mask=dynamic_mask(image, within))
    return image, replace(entry, mask=(named_mask(file, name, f"{entry.where}.mask_path", within), False))
