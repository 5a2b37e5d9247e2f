"""Poses as a file gives them, and how they are bound to image files to make a dataset."""

from __future__ import annotations

import posixpath
import unicodedata
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from biresnerf.data.model.camera import Camera
from biresnerf.data.model.dataset import Dataset, Frame, IntrinsicsSource, SourceFormat
from biresnerf.data.model.pose_validation import refuse_coinciding
from biresnerf.data.model.safe_names import refuse_outside
from biresnerf.data.photos.guessed_lens import guess_lens, guess_note
from biresnerf.data.photos.image_files import ImageHeader, read_header
from biresnerf.data.photos.mask_files import mask_beside
from biresnerf.data.photos.named_images import few_names, photos_beside, refuse_no_images, refuse_too_few
from biresnerf.data.photos.orientation import (
    meant_orientations,
    orientation_notes,
    page_notes,
    same_shape,
    turned_header,
)
from biresnerf.errors import InputError
from biresnerf.report import PoseSource

_IMAGES = "images/"
# The lens of an image by its header and name, where the pose file does not give it without them.
LensOf: TypeAlias = Callable[[ImageHeader, str], Camera | None]


@dataclass(frozen=True, eq=False)
class PoseEntry:
    """One image as a pose file describes it, before any image file is opened.

    Attributes:
        name: what the file calls it; its number where the file has no names.
        world_from_cam: float64 [4, 4], OpenCV axes; None where the file has no pose for it.
        where: the file, and the place in it, for messages.
        lens: its intrinsics, for the size that the file means, which may differ from the image's; None if unknown.
        timestamp_s: when it was taken, where the file gives that.
        camera_id: the file's own number of the camera: cameras of different numbers stay apart even if equal.
        raw: the entry as a transforms.json has it.
    """

    name: str
    world_from_cam: NDArray[np.float64] | None
    where: str
    lens: Camera | LensOf | None = None
    timestamp_s: float | None = None
    camera_id: int | None = None
    raw: dict[str, Any] = field(default_factory=dict)


# Pairs of an image file's name and its entry, in the order of the dataset, and notes for the user.
Assignment: TypeAlias = tuple[list[tuple[str, PoseEntry]], list[str]]


@dataclass(frozen=True, eq=False)
class ParsedPoses:
    """What a pose file says: names, poses and lenses.

    Attributes:
        source: the format, and the files that were read.
        entries: in the file's order.
        assign: which entry belongs to which image file, given the names of those files, sorted; by the entries' names
            where left out. Raises InputError where that cannot be decided.
        named: whether the file itself says which images its poses are for.
        notes: for the user.
    """

    source: SourceFormat
    entries: tuple[PoseEntry, ...]
    assign: Callable[[Sequence[str]], Assignment] | None = None
    named: bool = True
    notes: tuple[str, ...] = ()


def bind_images(parsed: ParsedPoses, root: Path, within: Path | None = None) -> Dataset:
    """The dataset of parsed poses and the images in or below ``root``.

    Args:
        within: refuse files outside of this folder; for uploaded sets.

    Raises:
        InputError: ``no_images``, ``image_missing``, ``pose_count_mismatch`` or a code of `dataset_of`.
    """
    files = photos_beside(root)
    refuse_no_images(files, root)
    names = sorted(files)
    pairs, notes = parsed.assign(names) if parsed.assign is not None else by_name(parsed.entries, names)
    images = [(files[name], entry) for name, entry in pairs]
    return dataset_of(root, images, parsed.source, [*parsed.notes, *notes], within)


def by_name(entries: Sequence[PoseEntry], names: Sequence[str]) -> Assignment:
    """Each entry with the image file of its name. Raises InputError ``image_missing``."""
    found, notes = match_files([entry.name for entry in entries], names, lambda i: entries[i].where)
    return list(zip(found, entries, strict=True)), notes


def in_order(entries: Sequence[PoseEntry], names: Sequence[str], file: str, hint: str) -> Assignment:
    """The entries with the images in the order of their names. Raises InputError ``pose_count_mismatch``."""
    if len(names) != len(entries):
        raise InputError(
            "pose_count_mismatch",
            f"has {len(entries)} poses for {len(names)} images, and does not say which belongs to which.",
            where=file,
            hint=hint,
        )
    pairs = [(name, replace(entry, name=name)) for name, entry in zip(names, entries, strict=True)]
    return pairs, [f"{file}: images were taken in the order of their names"]


def dataset_of(
    root: Path,
    images: Sequence[tuple[Path, PoseEntry]],
    source: SourceFormat,
    notes: Sequence[str],
    within: Path | None,
) -> Dataset:
    """The dataset of these images, in their order; reads their headers and looks for masks in masks/.

    Raises:
        InputError: ``too_few_images``, ``unsafe_path``, ``image_size_mismatch``, ``poses_coincide``, or a code of
            `read_header`.
    """
    place = source.files[0].name if source.files else root.name
    refuse_too_few(len(images), place)
    names = [entry.name for _, entry in images]
    if within is not None:
        refuse_outside([path for path, _ in images], names, within, place)
    stored = [read_header(path, entry.name) for path, entry in images]
    lenses = [
        entry.lens(header, entry.name) if callable(entry.lens) else entry.lens
        for (_, entry), header in zip(images, stored, strict=True)
    ]
    sizes = [(None, None) if lens is None else (float(lens.width), float(lens.height)) for lens in lenses]
    orientations = meant_orientations(stored, sizes)
    headers = [turned_header(header, turn) for header, turn in zip(stored, orientations, strict=True)]
    warnings = [*notes, *orientation_notes(stored, orientations, names), *page_notes(stored, names)]
    cameras: dict[tuple[Camera, IntrinsicsSource, int | None], int] = {}
    frames = []
    for (path, entry), lens, header, orientation in zip(images, lenses, headers, orientations, strict=True):
        if lens is None:
            fitted, by = guess_lens(header)
        else:
            fitted, by = fitted_camera(lens, header, entry, warnings), "given"
        index = cameras.setdefault((fitted, by, entry.camera_id), len(cameras))
        mask, inverted = mask_beside(root, path, entry.name, within)
        pose_source: PoseSource | None = None if entry.world_from_cam is None else "given"
        frames.append(
            Frame(
                entry.name, path, index, entry.world_from_cam, pose_source, entry.raw,
                mask=mask, mask_inverted=inverted, orientation=orientation, timestamp_s=entry.timestamp_s,
            )
        )  # fmt: skip
    poses = [frame.world_from_cam for frame in frames if frame.world_from_cam is not None]
    refuse_coinciding(poses, place)
    warnings += _pose_notes(frames) + _mask_notes(frames)
    sources = tuple(by for _, by, _ in cameras)
    if poses:
        warnings += [guess_note(by) for by in sources if by != "given"]
    return Dataset(
        root,
        tuple(camera for camera, _, _ in cameras),
        tuple(frames),
        source,
        tuple(dict.fromkeys(warnings)),
        sources,
    )


def fitted_camera(camera: Camera, header: ImageHeader, image: PoseEntry, notes: list[str]) -> Camera:
    """``camera`` resized to the image's true size. Raises InputError ``image_size_mismatch`` for another shape."""
    size = (header.width, header.height)
    if (camera.width, camera.height) == size:
        return camera
    sizes = f"{image.name} has {size[0]} x {size[1]} px, its camera {camera.width} x {camera.height}"
    if not same_shape(camera.width, camera.height, *size):
        turned = (camera.height, camera.width) == size
        raise InputError(
            "image_size_mismatch",
            f"{sizes}: {'turned by 90 degrees' if turned else 'not the same shape'}.",
            where=image.where,
            hint="Give the intrinsics of these images; cropped or turned images need their own.",
        )
    notes.append(
        f"{camera.width} x {camera.height} px in the camera, {size[0]} x {size[1]} in the images: "
        "the intrinsics were scaled to the images"
    )
    return camera.resized(*size)


def match_files(
    names: Sequence[str], files: Sequence[str], where: Callable[[int], str]
) -> tuple[list[str], list[str]]:
    """The file that each name means, and notes.

    The same path, below images/ or with it; else, where one name and one file alone share it, the same in another
    Unicode form, then the same file name in another folder, then with letters of another case, then with another
    extension.

    Raises:
        InputError: ``image_missing``.
    """
    found: dict[str, str] = {}
    free = set(files)
    spellings: tuple[Callable[[str], str], ...] = (
        lambda name: name,
        lambda name: name.replace("\\", "/"),
        lambda name: name.removeprefix(_IMAGES),
        lambda name: _IMAGES + name,
    )
    for key in spellings:
        for name in names:
            if name not in found and key(name) in free:
                found[name] = key(name)
                free.remove(key(name))
    notes = []
    for rule, key in (
        ("by the same name in another Unicode form", lambda name: unicodedata.normalize("NFC", name)),
        ("by file name alone", posixpath.basename),
        ("by file name, whatever its case", lambda name: posixpath.basename(name).casefold()),
        (
            "by file name without extension",
            lambda name: posixpath.splitext(posixpath.basename(name))[0].casefold(),
        ),
    ):
        open_names = _unique([name for name in names if name not in found], key)
        open_files = _unique([file for file in files if file not in found.values()], key)
        pairs = {name: open_files[shared] for shared, name in open_names.items() if shared in open_files}
        if pairs:
            example = next(iter(pairs.items()))
            notes.append(f"{len(pairs)} images were found {rule} ({example[0]} is {example[1]})")
        found |= pairs
    missing = [index for index, name in enumerate(names) if name not in found]
    if missing:
        raise InputError(
            "image_missing",
            f"{len(missing)} of {len(names)} images not found: {few_names(names[i] for i in missing)}.",
            where=where(missing[0]),
            hint="Put the images into images/ under the names that the poses are given for.",
        )
    return [found[name] for name in names], notes


def _unique(names: Sequence[str], key: Callable[[str], str]) -> dict[str, str]:
    grouped: dict[str, list[str]] = {}
    for name in names:
        grouped.setdefault(key(name), []).append(name)
    return {shared: group[0] for shared, group in grouped.items() if len(group) == 1}


def _pose_notes(frames: Sequence[Frame]) -> list[str]:
    without = [frame.name for frame in frames if frame.world_from_cam is None]
    if not without or len(without) == len(frames):
        return []
    return [f"{len(without)} of {len(frames)} images have no pose yet: {few_names(without)}"]


def _mask_notes(frames: Sequence[Frame]) -> list[str]:
    masked = sum(frame.mask is not None for frame in frames)
    return [f"masks were found for {masked} of {len(frames)} images"] if masked else []
