"""Poses as a file gives them, and how they are bound to image files to make a dataset."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from biresnerf.data.formats.bad_frames import attempt, good_frames, said, tolerate
from biresnerf.data.formats.match_names import match_files
from biresnerf.data.model.dataset import Dataset, Frame, IntrinsicsSource, SourceFormat
from biresnerf.data.model.pose_validation import refuse_coinciding
from biresnerf.data.photos.guessed_lens import guess_lens, guess_note
from biresnerf.data.photos.image_files import ImageHeader, read_header
from biresnerf.data.photos.masks import mask_beside
from biresnerf.data.photos.named_images import refuse_outside, refuse_too_few
from biresnerf.data.photos.orientation import (
    meant_orientations,
    orientation_notes,
    page_notes,
    same_shape,
    turned_header,
)
from biresnerf.data.photos.photo_folders import all_photos, few_names, photos_beside, refuse_no_images
from biresnerf.errors import InputError
from biresnerf.geometry.camera.camera_models import Camera


class FrameCamera(NamedTuple):
    """The camera of one image, who found its intrinsics, whether other images share them, and notes for the user."""

    camera: Camera
    source: IntrinsicsSource = "given"
    shared: bool = False
    notes: tuple[str, ...] = ()


# The lens of an image by its header and name, where the pose file does not give it without them. It fits the header.
LensOf: TypeAlias = Callable[[ImageHeader, str], FrameCamera]


@dataclass(frozen=True, eq=False)
class PoseEntry:
    """One image as a pose file describes it, before any image file is opened.

    Attributes:
        name: what the file calls it; its number where the file has no names.
        world_from_cam: float64 [4, 4], OpenCV axes; None where the file has no pose for it.
        where: the file, and the place in it, for messages.
        lens: its intrinsics, for the size that the file means, which may differ from the image's; None if unknown.
        size: width and height that the file declares where ``lens`` depends on the image; None where it does not.
        timestamp_s: when it was taken, where the file gives that.
        camera_id: the file's own number of the camera: cameras of different numbers stay apart even if equal.
        raw: the entry as a transforms.json has it.
        mask: the file of its mask, or None, and whether the mask is inverted; looked for in masks/ where left out.
        problem: why the file's pose or lens for it cannot be used.
    """

    name: str
    world_from_cam: NDArray[np.float64] | None
    where: str
    lens: Camera | LensOf | None = None
    size: tuple[float | None, float | None] = (None, None)
    timestamp_s: float | None = None
    camera_id: int | None = None
    raw: dict[str, Any] = field(default_factory=dict)
    mask: tuple[Path | None, bool] | None = None
    problem: InputError | None = None


# Pairs of an image file's name and its entry, in the order of the dataset, and notes for the user.
Assignment: TypeAlias = tuple[list[tuple[str, PoseEntry]], list[str]]


@dataclass(frozen=True, eq=False)
class ParsedPoses:
    """The content of a pose file: names, poses and lenses.

    Attributes:
        source: the format, and the files that were read.
        entries: in the file's order.
        assign: matches entries to image files, given the sorted names of those files; by the entries' names where
            left out. Raises InputError where that cannot be decided.
        named: whether the file itself names the images of its poses.
        notes: for the user.
        take_file_names: images are called as their files are from here on, as the pose file's names may lack the
            extension.
        photo_folders: where the format keeps its photos, relative to the root, the preferred one first.
        strict: refuse the set for one bad frame.
    """

    source: SourceFormat
    entries: tuple[PoseEntry, ...]
    assign: Callable[[Sequence[str]], Assignment] | None = None
    named: bool = True
    notes: tuple[str, ...] = ()
    take_file_names: bool = False
    photo_folders: tuple[str, ...] = ()
    strict: bool = False


def without_problems(parsed: ParsedPoses, *, strict: bool = False) -> ParsedPoses:
    """The same with a note on the entries that have a problem; they stay, without pose.

    Raises:
        InputError: the first problem, where less than most of the entries, or fewer than three, are good.
    """
    bad = [entry for entry in parsed.entries if entry.problem is not None]
    notes = parsed.notes
    if bad and bad[0].problem is not None:
        tolerate(len(bad), len(parsed.entries), bad[0].problem, strict=strict)
        listed = few_names((said(entry.problem) for entry in bad if entry.problem is not None), 3)
        notes = (
            *notes,
            f"{len(bad)} of {len(parsed.entries)} poses cannot be used and are left out: {listed}",
        )
    return replace(parsed, notes=notes, strict=strict)


def bind_images(parsed: ParsedPoses, root: Path, within: Path | None = None) -> Dataset:
    """The dataset of parsed poses and the images in or below ``root``.

    Args:
        within: refuse files outside of this folder; for uploaded sets.

    Raises:
        InputError: ``no_images``, ``image_missing``, ``pose_count_mismatch`` or a code of `dataset_of`.
    """
    named = parsed.assign is None
    files = photos_beside(root, parsed.photo_folders)
    if named and not files:
        files = all_photos(root)
    refuse_no_images(files, root)
    names = sorted(files)
    assign = parsed.assign or partial(by_name, parsed.entries, strict=parsed.strict)
    pairs, notes = assign(names)
    if parsed.take_file_names:
        pairs = [(name, replace(entry, name=name)) for name, entry in pairs]
    images = [(files[name], entry) for name, entry in pairs]
    return dataset_of(root, images, parsed.source, [*parsed.notes, *notes], within, strict=parsed.strict)


def by_name(entries: Sequence[PoseEntry], names: Sequence[str], *, strict: bool = False) -> Assignment:
    """Each entry with the image file of its name; those whose file is missing are left out where most are there.

    Raises:
        InputError: ``image_missing``.
    """
    found, notes = match_files([entry.name for entry in entries], names)
    missing = [entry for entry in entries if entry.name not in found]
    if missing:
        listed = (
            f"{len(missing)} of {len(entries)} images not found: {few_names(one.name for one in missing)}"
        )
        hint = "Put the images into images/ under the names that the poses are given for."
        error = InputError("image_missing", f"{listed}.", where=missing[0].where, hint=hint)
        tolerate(len(missing), len(entries), error, strict=strict)
        notes.append(f"{listed}; they are left out")
    return [(found[entry.name], entry) for entry in entries if entry.name in found], notes


def in_order(entries: Sequence[PoseEntry], names: Sequence[str], file: str, hint: str) -> Assignment:
    """The entries with the images in the order of their names. Raises InputError ``pose_count_mismatch``."""
    if len(names) != len(entries):
        detail = f"has {len(entries)} poses for {len(names)} images, and does not say which belongs to which."
        raise InputError("pose_count_mismatch", detail, where=file, hint=hint)
    pairs = [(name, replace(entry, name=name)) for name, entry in zip(names, entries, strict=True)]
    return pairs, [f"{file}: images were taken in the order of their names"]


def dataset_of(
    root: Path,
    images: Sequence[tuple[Path, PoseEntry]],
    source: SourceFormat,
    notes: Sequence[str],
    within: Path | None,
    *,
    table: str = "",
    strict: bool = False,
) -> Dataset:
    """The dataset of these images, in their order; reads their headers and looks for masks.

    Images that cannot be read, or whose lens cannot be used, are left out where most are good.

    Args:
        table: the part of the pose file that lists the images, for messages.
        strict: refuse the set for one bad image.

    Raises:
        InputError: ``too_few_images``, ``unsafe_path``, ``image_size_mismatch``, ``mixed_sizes``, ``poses_coincide``,
            or a code of `read_header` or of the entries' lenses.
    """
    place = f"{source.files[0].name} {table}".rstrip() if source.files else root.name
    refuse_too_few(len(images), place)
    names = [entry.name for _, entry in images]
    if within is not None:
        refuse_outside([path for path, _ in images], names, within, place)
    read = [attempt(partial(read_header, path, entry.name)) for path, entry in images]
    stored, kept, dropped = good_frames(read, names, strict=strict)
    images = [images[index] for index in kept]
    orientations = meant_orientations(stored, [_declared_size(entry) for _, entry in images])
    headers = [turned_header(header, turn) for header, turn in zip(stored, orientations, strict=True)]
    lenses = [
        attempt(partial(_camera_of, entry, header))
        for (_, entry), header in zip(images, headers, strict=True)
    ]
    found, kept, more = good_frames(lenses, [entry.name for _, entry in images], strict=strict)
    images, stored = [images[i] for i in kept], [stored[i] for i in kept]
    orientations = [orientations[i] for i in kept]
    names = [entry.name for _, entry in images]
    _refuse_mixed_sizes(found, [entry for _, entry in images])
    cameras: dict[tuple[Camera, IntrinsicsSource, int | None], int] = {}
    frames = []
    for (path, entry), lens, orientation in zip(images, found, orientations, strict=True):
        index = cameras.setdefault((lens.camera, lens.source, entry.camera_id), len(cameras))
        mask, inverted = entry.mask or mask_beside(root, path, entry.name, within)
        frames.append(
            Frame(
                entry.name, path, index, entry.world_from_cam,
                None if entry.world_from_cam is None else "given", entry.raw, mask=mask, mask_inverted=inverted,
                orientation=orientation, timestamp_s=entry.timestamp_s,
            )
        )  # fmt: skip
    refuse_coinciding([frame.world_from_cam for frame in frames if frame.world_from_cam is not None], place)
    warnings = [
        *notes,
        *dropped,
        *more,
        *orientation_notes(stored, orientations, names),
        *page_notes(stored, names),
    ]
    warnings += [note for lens in found for note in lens.notes]
    if source.files:  # a folder of images alone never has poses or intrinsics
        without = [frame.name for frame in frames if frame.world_from_cam is None]
        if without:
            what = f"{len(without)} of {len(frames)} {table or 'images'}"
            warnings.append(f"{what} have no pose yet: {few_names(without)}")
        warnings += [guess_note(lens.source) for lens in found if lens.source != "given"]
    masked = sum(frame.mask is not None for frame in frames)
    if masked:
        warnings.append(f"masks were found for {masked} of {len(frames)} images")
    return Dataset(
        root,
        tuple(camera for camera, _, _ in cameras),
        tuple(frames),
        source,
        tuple(dict.fromkeys(warnings)),
        tuple(by for _, by, _ in cameras),
    )


def _declared_size(entry: PoseEntry) -> tuple[float | None, float | None]:
    return (entry.lens.width, entry.lens.height) if isinstance(entry.lens, Camera) else entry.size


def _camera_of(entry: PoseEntry, header: ImageHeader) -> FrameCamera:
    """The entry's camera at the image's true size. Raises InputError ``image_size_mismatch`` for another shape."""
    if entry.lens is None:
        return FrameCamera(*guess_lens(header))
    if not isinstance(entry.lens, Camera):
        return entry.lens(header, entry.name)
    camera, size = entry.lens, (header.width, header.height)
    if (camera.width, camera.height) == size:
        return FrameCamera(camera)
    if not same_shape(camera.width, camera.height, *size):
        how = "turned by 90 degrees" if (camera.height, camera.width) == size else "not the same shape"
        raise InputError(
            "image_size_mismatch",
            f"{entry.name} has {size[0]} x {size[1]} px, its camera {camera.width} x {camera.height}: {how}.",
            where=entry.where,
            hint="Give the intrinsics of these images; cropped or turned images need their own.",
        )
    note = (
        f"{camera.width} x {camera.height} px in the camera, {size[0]} x {size[1]} in the images: "
        "the intrinsics were scaled to the images"
    )
    return FrameCamera(camera.resized(*size), notes=(note,))


def _refuse_mixed_sizes(found: Sequence[FrameCamera], entries: Sequence[PoseEntry]) -> None:
    """Raises InputError ``mixed_sizes`` where images of different sizes share intrinsics."""
    sizes: dict[tuple[int, int], PoseEntry] = {}
    for lens, entry in zip(found, entries, strict=True):
        if lens.shared:
            sizes.setdefault((lens.camera.width, lens.camera.height), entry)
    if len(sizes) > 1:
        (size_a, a), (size_b, b) = list(sizes.items())[:2]
        raise InputError(
            "mixed_sizes",
            f"{a.name} has {size_a[0]} x {size_a[1]} px, {b.name} {size_b[0]} x {size_b[1]} px, "
            "but the intrinsics are shared.",
            where=b.where,
            hint="Give each frame its own fl_x, fl_y, cx, cy, w and h, or images of one size.",
        )
