"""Any input a user may give, read and validated."""

from __future__ import annotations

import posixpath
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from biresnerf.data.formats.bind_images import dataset_of
from biresnerf.data.formats.folder import FolderContents, look_at, look_into, other_parts_notes
from biresnerf.data.formats.parsed_poses import ParsedPoses, PoseEntry, without_problems
from biresnerf.data.formats.positions.control_points import control_files, control_notes
from biresnerf.data.formats.positions.position_priors import position_notes
from biresnerf.data.formats.positions.position_table import position_files
from biresnerf.data.formats.registry import ALL_CODECS
from biresnerf.data.formats.unread_poses import pose_like_notes
from biresnerf.data.model.colmap_scene import NO_POINT
from biresnerf.data.model.dataset import Dataset, SourceFormat
from biresnerf.data.model.image_order import natural_key
from biresnerf.data.photos.masks import refuse_unfit_mask
from biresnerf.data.photos.named_images import refuse_outside
from biresnerf.data.photos.photo_folders import few_names, left_out_notes, photos_beside
from biresnerf.data.photos.video.video_frames import (
    EACH_VIDEO,
    VIDEO_FRAMES,
    VideoReading,
    frames_of_videos,
)
from biresnerf.errors import InputError


def read_dataset(
    path: Path, within: Path | None = None, *, strict: bool = False, videos: VideoReading = EACH_VIDEO
) -> Dataset:
    """Reads poses in any format of docs/formats.md with their images, or a folder of images alone, or of videos.

    Everything is validated but the pixels, which `photos.images.load_images` decodes. Frames may lack poses:
    `seeding.seed_poses` finds them.

    Args:
        path: a folder, or the file in it that has the poses, or a video.
        within: refuse files outside of this folder; for uploaded sets.
        strict: refuse the set for one bad frame, else leave bad frames out where most are good.
        videos: how many frames of videos are wanted. They are written beside the videos, into video_frames/, unless
            they are there already.

    Raises:
        InputError: the input cannot be used; says the file, the field and a hint.
    """
    contents = find_input(Path(path), within)
    if contents.format is None or contents.poses is None:
        images, notes = _with_video_frames(contents, within, videos)
        dataset = _read_images(contents.root, images, within, strict=strict)
        known = [*position_files(contents.root), *control_files(contents.root)]
        notes += [] if contents.videos else pose_like_notes(contents.root, dataset.names, known)
        contents = replace(contents, notes=(*contents.notes, *notes))
    else:
        codec = ALL_CODECS[contents.format]
        if within is not None and codec.refuse_early is not None:
            codec.refuse_early(contents.poses, within)
        parsed = _parse(contents.format, contents.root, contents.poses)
        dataset = codec.bind(without_problems(parsed, strict=strict), contents.root, within)
        top = Path(path) if Path(path).is_dir() else contents.root
        parts = other_parts_notes(top, [frame.path for frame in dataset.frames])
        contents = replace(contents, notes=(*contents.notes, *parts))
    for index, frame in enumerate(dataset.frames):
        refuse_unfit_mask(frame, dataset.camera_of(index))
    used = [
        *contents.videos,
        *(path for f in dataset.frames for path in (f.path, f.mask) if path is not None),
    ]
    contents = replace(contents, notes=(*contents.notes, *position_notes(dataset), *control_notes(dataset)))
    left_out = () if path in contents.videos else left_out_notes(contents.root, used)
    return replace(dataset, warnings=(*contents.notes, *left_out, *dataset.warnings))


def _with_video_frames(
    contents: FolderContents, within: Path | None, videos: VideoReading
) -> tuple[list[Path], list[str]]:
    """The images and the frames of the videos beside them, and a note on these."""
    if not contents.videos:
        return list(contents.images), []
    names = [video.name for video in contents.videos]
    if within is not None:
        refuse_outside(contents.videos, names, within, contents.root.name)
    frames = frames_of_videos(contents.videos, contents.root, videos)
    note = f"{len(frames)} frames of {few_names(names)} were chosen by sharpness and motion: {VIDEO_FRAMES}/"
    return [*contents.images, *frames], [note]


def read_poses(path: Path) -> dict[str, NDArray[np.float64]]:
    """``world_from_cam`` [4, 4] (OpenCV axes, in the world from before ``applied_transform``) by image name.

    The images need not be there. Frames without a pose are left out. Names are as the file has them, with ``./`` and
    the like resolved. Poses that a file gives without names (LLFF, KITTI, TUM) are those of the images beside it, where
    these fit; else they are called by their time or number.

    Args:
        path: a file in any format that `read_dataset` reads, or a folder that holds one.

    Raises:
        InputError: ``pose_file_invalid`` or another code of the format's reader; ``where`` starts with the path.
    """
    hint = (
        "Give a transforms.json as nerfstudio, instant-ngp or Blender write it, or one written by `refine`."
    )
    try:
        contents = find_input(path)
        name, place = contents.format, contents.poses
    except InputError as error:
        if error.code in ("input_missing", "input_unreadable"):
            raise _at(path, error, path.name) from None
        name, place = None, None
    if name is None or place is None:
        raise InputError("pose_file_invalid", "holds no poses that can be read.", where=str(path), hint=hint)
    poses: dict[str, NDArray[np.float64]] = {}
    seen: set[str] = set()
    try:
        for entry in _named_entries(_usable(name, contents.root, place), contents.root):
            if not entry.name:
                where = f"{entry.where}.file_path"
                raise InputError("pose_file_invalid", "names no image.", where=where, hint=hint)
            image = posixpath.normpath(entry.name)
            if image in seen:
                detail = f"{image!r} is there twice."
                raise InputError("duplicate_image", detail, where=entry.where, hint="Remove one.")
            seen.add(image)
            if entry.world_from_cam is not None:
                poses[image] = entry.world_from_cam
    except InputError as error:
        raise _at(place, error, place.name) from None
    return poses


def seen_points(path: Path) -> dict[str, set[int]]:
    """The ids of the points that each image sees, by its name as in `read_poses`; empty for all but COLMAP's models."""
    contents = find_input(path)
    if contents.format is None or contents.poses is None:
        return {}
    model = _parse(contents.format, contents.root, contents.poses).source.colmap
    images = () if model is None else model.images.values()
    return {posixpath.normpath(one.name): {*one.point3d_ids.tolist()} - {NO_POINT} for one in images}


def find_input(path: Path, within: Path | None = None) -> FolderContents:
    """What is read of ``path``. Raises InputError where it holds nothing readable."""
    if path.is_file():
        return look_at(path, within)
    if path.is_dir():
        return look_into(path)
    raise InputError(
        "input_missing", "does not exist.", where=str(path), hint="Give a folder, or a file with poses."
    )


def _usable(name: str, root: Path, place: Path) -> ParsedPoses:
    return without_problems(_parse(name, root, place))


def _parse(name: str, root: Path, place: Path) -> ParsedPoses:
    parse = ALL_CODECS[name].parse
    assert parse is not None, "only formats that are read are found"
    return parse(root, place)


def _read_images(root: Path, images: Sequence[Path], within: Path | None, *, strict: bool) -> Dataset:
    """The images as frames without pose, named by their path relative to ``root``."""
    names = [path.relative_to(root).as_posix() for path in images]
    root = root.resolve()  # "." has no name
    entries = [(root / name, PoseEntry(name, None, name)) for name in names]
    return dataset_of(root, entries, SourceFormat("images"), (), within, strict=strict)


def _named_entries(parsed: ParsedPoses, root: Path) -> Sequence[PoseEntry]:
    """The entries by their own names, else by those of the images beside them, where these fit."""
    beside = [] if parsed.named else sorted(photos_beside(root, parsed.photo_folders), key=natural_key)
    if beside and parsed.assign is not None:
        try:
            return [entry for _, entry in parsed.assign(beside)[0]]
        except InputError:
            pass  # images of something else
    return parsed.entries


def _at(path: Path, error: InputError, name: str) -> InputError:
    # Two files are compared, often of one name: only the whole path says which.
    own = error.where.startswith((name, str(path)))
    where = str(path) + (error.where.removeprefix(str(path)).removeprefix(name) if own else f"/{error.where}")
    return InputError(error.code, error.detail, where=where, hint=error.hint)
