"""transforms.json as nerfstudio, instant-ngp and Blender (NeRF-synthetic) write it, read and checked."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from biresnerf.data.conventions import world_from_cam_of_file
from biresnerf.data.dataset import Camera, Dataset, Dialect, Frame, SourceFormat
from biresnerf.data.image_files import ImageHeader, find_image, is_image_name, read_header
from biresnerf.data.intrinsics_json import Fields, camera_of_frame
from biresnerf.data.json_document import read_json_object
from biresnerf.data.orientation import meant_orientations, orientation_notes, page_notes, turned_header
from biresnerf.data.poses import ROTATION_WARNED, rigid_matrix
from biresnerf.errors import InputError

MIN_IMAGES = 3  # two views leave scale and much else open
_NGP_KEYS = frozenset(
    {"aabb_scale", "scale", "offset", "is_fisheye", "sharpness", "x_fov", "enable_depth_loading"}
)
_NERFSTUDIO_KEYS = frozenset({"camera_model", "applied_transform", "ply_file_path", "applied_scale"})


def read_transforms(path: Path, within: Path | None = None) -> Dataset:
    """The validated image set that the transforms file ``path`` describes; image headers are read only.

    Args:
        path: the file.
        within: refuse images outside of this folder; for files of strangers.

    Raises:
        InputError: with the file, the field and the mend; codes as in docs/input.md.
    """
    document = read_json_object(path)
    rows = _frame_objects(document, path.name)
    source = _source_format(document, path)
    names = _names(rows, path.name)
    if within is not None:
        _refuse_outside(path, names, within)
    paths = _find_images(path, names)
    _refuse_missing_poses(rows, names, path.name)
    stored = [read_header(image, name) for image, name in zip(paths, names, strict=True)]
    sizes = [_named_size(row, document) for row in rows]
    orientations = meant_orientations(stored, sizes)
    headers = [turned_header(header, o) for header, o in zip(stored, orientations, strict=True)]
    cameras, camera_indices, notes = _cameras(rows, source, headers, names, path.name)
    poses, pose_notes = _poses(rows, names, source, path.name)
    notes += (
        pose_notes
        + orientation_notes(stored, orientations, names)
        + page_notes(stored, names)
        + _ignored_notes(rows, document)
    )
    notes += _unused_image_notes(paths)
    frames = tuple(
        Frame(name, image, camera, pose, "given", row, orientation=orientation)
        for name, image, camera, pose, row, orientation in zip(
            names, paths, camera_indices, poses, rows, orientations, strict=True
        )
    )
    return Dataset(path.parent, cameras, frames, source, tuple(notes))


def few_names(names: Iterable[str], limit: int = 5) -> str:
    """A short list for a message: the first ``limit`` names and how many more."""
    listed = list(names)
    more = f" and {len(listed) - limit} more" if len(listed) > limit else ""
    return ", ".join(listed[:limit]) + more


def _named_size(row: dict[str, Any], document: dict[str, Any]) -> tuple[float | None, float | None]:
    """w and h that go with a frame; None for what is no number, which is refused where it is used."""
    top = {} if row.get("fl_x") is not None else document  # its own focal length goes with its own size
    width, height = (_usable(row.get(key, top.get(key))) for key in ("w", "h"))
    return width, height


def _usable(value: Any) -> float | None:
    return float(value) if isinstance(value, int | float) and 0 < value < 1e12 else None


def _frame_objects(document: dict[str, Any], file: str) -> list[dict[str, Any]]:
    rows = document.get("frames")
    if not isinstance(rows, list):
        raise InputError(
            "pose_file_invalid",
            "has no list of frames.",
            where=f"{file} frames",
            mend="Give a transforms.json as nerfstudio, instant-ngp or Blender write it.",
        )
    for index, row in enumerate(rows):
        if not isinstance(row, dict):
            raise InputError(
                "pose_file_invalid",
                "is not an object.",
                where=f"{file} frames[{index}]",
                mend="Give file_path and transform_matrix in each frame.",
            )
    refuse_too_few(len(rows), f"{file} frames")
    return rows


def refuse_too_few(count: int, where: str) -> None:
    """Raises InputError ``too_few_images`` where ``count`` images are too few to optimise anything."""
    if count < MIN_IMAGES:
        raise InputError(
            "too_few_images",
            f"{count} image{'' if count == 1 else 's'}; at least {MIN_IMAGES} are needed.",
            where=where,
            mend="Add views that overlap; 20 to 100 are good.",
        )


def _source_format(document: dict[str, Any], path: Path) -> SourceFormat:
    applied = document.get("applied_transform")
    matrix, scale = np.eye(4), document.get("applied_scale", 1.0)
    if applied is not None:
        matrix, _ = rigid_matrix(applied, f"{path.name} applied_transform")
    if isinstance(scale, bool) or not isinstance(scale, int | float) or not 1e-9 < scale < 1e9:
        raise InputError(
            "pose_file_invalid",
            "is not a positive number.",
            where=f"{path.name} applied_scale",
            mend="Remove the key, or give the factor that was applied to the positions.",
        )
    kept = {key: None if key == "frames" else value for key, value in document.items()}
    return SourceFormat(_dialect(document), path, kept, matrix, float(scale))


def _dialect(document: dict[str, Any]) -> Dialect:
    if document.keys() & _NERFSTUDIO_KEYS:
        return "nerfstudio"
    if document.keys() & _NGP_KEYS:
        return "instant-ngp"
    first = document["frames"][0]
    return (
        "blender"
        if "camera_angle_x" in document and "fl_x" not in document.keys() | first.keys()
        else "nerfstudio"
    )


def _names(rows: list[dict[str, Any]], file: str) -> list[str]:
    names = []
    for index, row in enumerate(rows):
        name = row.get("file_path")
        if not isinstance(name, str) or not name:
            raise InputError(
                "frame_without_image",
                "the frame names no image.",
                where=f"{file} frames[{index}].file_path",
                mend="Give the image's path relative to this file, or remove the frame.",
            )
        names.append(name)
    return names


def _refuse_outside(path: Path, names: list[str], within: Path) -> None:
    """Names that lead out of ``within`` are refused before anything is looked for there, links included."""
    limit = within.resolve()
    for index, name in enumerate(names):
        for spelling in (name, name.replace("\\", "/")):
            if not _lies_in(path.parent / spelling, limit):
                raise InputError(
                    "unsafe_path",
                    f"{name[:100]!r} leads out of the image set's folder.",
                    where=f"{path.name} frames[{index}].file_path",
                    mend="Name images by their path relative to this file, inside the folder.",
                )


def _lies_in(path: Path, limit: Path) -> bool:
    try:
        return path.resolve().is_relative_to(limit)
    except (OSError, ValueError):  # too long, or a NUL in it: no such file anyway
        return False


def _find_images(path: Path, names: list[str]) -> list[Path]:
    found = [find_image(path.parent, name) for name in names]
    missing = [index for index, image in enumerate(found) if image is None]
    if missing:
        raise InputError(
            "image_missing",
            f"{len(missing)} of {len(names)} images not found: {few_names(names[i] for i in missing)}.",
            where=f"{path.name} frames[{missing[0]}].file_path",
            mend="Put the images there (paths are relative to the file), or remove their frames.",
        )
    images = [image for image in found if image is not None]
    places: dict[str, int] = {}
    for index, image in enumerate(images):
        first = places.setdefault(str(image.resolve()), index)
        if first != index:
            raise InputError(
                "duplicate_image",
                f"{names[index]!r} is the same file as {names[first]!r} in frames[{first}].",
                where=f"{path.name} frames[{index}].file_path",
                mend="Remove one of the two frames.",
            )
    return images


def _refuse_missing_poses(rows: list[dict[str, Any]], names: list[str], file: str) -> None:
    without = [index for index, row in enumerate(rows) if row.get("transform_matrix") is None]
    if without:
        raise InputError(
            "pose_missing",
            f"{len(without)} of {len(rows)} frames have no pose: {few_names(names[i] for i in without)}.",
            where=f"{file} frames[{without[0]}].transform_matrix",
            mend="Remove these frames, or give a folder of images alone to have all poses found by COLMAP.",
        )


def _cameras(
    rows: list[dict[str, Any]], source: SourceFormat, headers: list[ImageHeader], names: list[str], file: str
) -> tuple[tuple[Camera, ...], list[int], list[str]]:
    cameras: dict[Camera, int] = {}
    shared_sizes: dict[tuple[int, int], int] = {}
    indices: list[int] = []
    notes: dict[str, None] = {}
    for index, (row, header, name) in enumerate(zip(rows, headers, names, strict=True)):
        result = camera_of_frame(Fields(row, source.document, file, index), header, name)
        if not result.own:
            shared_sizes.setdefault((header.width, header.height), index)
        indices.append(cameras.setdefault(result.camera, len(cameras)))
        notes.update(dict.fromkeys(result.notes))
    if len(shared_sizes) > 1:
        (size_a, a), (size_b, b) = list(shared_sizes.items())[:2]
        raise InputError(
            "mixed_sizes",
            f"{names[a]} has {size_a[0]} x {size_a[1]} px, {names[b]} {size_b[0]} x {size_b[1]} px, "
            "but the intrinsics are shared.",
            where=f"{file} frames[{b}]",
            mend="Give each frame its own fl_x, fl_y, cx, cy, w and h, or images of one size.",
        )
    return tuple(cameras), indices, list(notes)


def _poses(
    rows: list[dict[str, Any]], names: list[str], source: SourceFormat, file: str
) -> tuple[NDArray[np.float64], list[str]]:
    matrices, worst, worst_name = [], 0.0, ""
    for index, (row, name) in enumerate(zip(rows, names, strict=True)):
        matrix, deviation = rigid_matrix(row["transform_matrix"], f"{file} frames[{index}].transform_matrix")
        matrices.append(matrix)
        if deviation > worst:
            worst, worst_name = deviation, name
    notes = []
    if worst > ROTATION_WARNED:
        notes.append(f"rotations were made orthonormal; the worst was off by {worst:.1e} ({worst_name})")
    poses = world_from_cam_of_file(np.stack(matrices), source.applied_transform, source.applied_scale)
    centres = poses[:, :3, 3]
    if np.ptp(centres, axis=0).max() <= 1e-9 * max(1.0, float(np.abs(centres).max())):
        raise InputError(
            "poses_coincide",
            "all cameras stand at one point, so there is no parallax to work from.",
            where=f"{file} frames",
            mend="Give poses with different positions, or the images alone to have them found by COLMAP.",
        )
    return poses, notes


def _ignored_notes(rows: list[dict[str, Any]], document: dict[str, Any]) -> list[str]:
    notes = []
    if any("mask_path" in row or "mask" in row for row in rows):
        notes.append("masks are not used yet: masked pixels count like all others")
    if any(row.get("rolling_shutter") or document.get("rolling_shutter") for row in rows):
        notes.append("rolling_shutter is not modelled")
    return notes


def _unused_image_notes(paths: list[Path]) -> list[str]:
    used = {path.resolve() for path in paths}
    suffixes = {path.suffix.lower() for path in paths}
    unused = []
    for folder in sorted({path.parent.resolve() for path in paths}):
        for path in sorted(folder.iterdir()):
            if (
                path.suffix.lower() in suffixes
                and is_image_name(path)
                and path not in used
                and path.is_file()
            ):
                unused.append(path.name)
    if not unused:
        return []
    return [
        f"{len(unused)} images beside the used ones have no frame and are left out: {few_names(unused, 3)}"
    ]
