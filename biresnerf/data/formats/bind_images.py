"""Images that a pose file other than transforms.json describes, checked against the files and made a dataset."""

from __future__ import annotations

import posixpath
import unicodedata
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from biresnerf.data.model.dataset import Camera, Dataset, Frame, IntrinsicsSource, SourceFormat
from biresnerf.data.model.pose_validation import refuse_coinciding
from biresnerf.data.model.safe_names import refuse_outside
from biresnerf.data.photos.guessed_lens import guess_lens, guess_note
from biresnerf.data.photos.image_files import ImageHeader, read_header
from biresnerf.data.photos.mask_files import mask_beside
from biresnerf.data.photos.named_images import few_names, refuse_too_few
from biresnerf.data.photos.orientation import (
    meant_orientations,
    orientation_notes,
    page_notes,
    same_shape,
    turned_header,
)
from biresnerf.errors import InputError

_IMAGES = "images/"


@dataclass(frozen=True, eq=False)
class GivenImage:
    """One image as a pose file has it.

    Attributes:
        name: what the file calls it.
        path: the image file.
        camera: its intrinsics, for the size that the file means, which may be another than the image's; None where
            nobody gave any.
        world_from_cam: float64 [4, 4], OpenCV axes; None where the file has no pose for it.
        where: the file, and the place in it, for messages.
        timestamp_s: when it was taken, where the file says so.
        camera_id: the file's own number of the camera: cameras of different numbers stay apart, equal as they may be.
    """

    name: str
    path: Path
    camera: Camera | None
    world_from_cam: NDArray[np.float64] | None
    where: str
    timestamp_s: float | None = None
    camera_id: int | None = None


def dataset_of(
    root: Path,
    images: Sequence[GivenImage],
    source: SourceFormat,
    notes: Sequence[str],
    within: Path | None,
) -> Dataset:
    """The dataset of these images, in their order; headers are read, masks/ is looked into.

    Raises:
        InputError: ``too_few_images``, ``unsafe_path``, ``image_size_mismatch``, ``poses_coincide``, or a code of
            `read_header`.
    """
    place = source.files[0].name if source.files else root.name
    refuse_too_few(len(images), place)
    names = [image.name for image in images]
    if within is not None:
        refuse_outside([image.path for image in images], names, within, place)
    stored = [read_header(image.path, image.name) for image in images]
    sizes = [
        (None, None) if image.camera is None else (float(image.camera.width), float(image.camera.height))
        for image in images
    ]
    orientations = meant_orientations(stored, sizes)
    headers = [turned_header(header, turn) for header, turn in zip(stored, orientations, strict=True)]
    said = [*notes, *orientation_notes(stored, orientations, names), *page_notes(stored, names)]
    cameras: dict[tuple[Camera, IntrinsicsSource, int | None], int] = {}
    frames = []
    for image, header, orientation in zip(images, headers, orientations, strict=True):
        if image.camera is None:
            fitted, by = guess_lens(header)
        else:
            fitted, by = fitted_camera(image.camera, header, image, said), "given"
        index = cameras.setdefault((fitted, by, image.camera_id), len(cameras))
        mask, inverted = mask_beside(root, image.path, image.name, within)
        pose_source = None if image.world_from_cam is None else "given"
        frames.append(
            Frame(
                image.name, image.path, index, image.world_from_cam, pose_source,  # type: ignore[arg-type]
                mask=mask, mask_inverted=inverted, orientation=orientation, timestamp_s=image.timestamp_s,
            )
        )  # fmt: skip
    refuse_coinciding([frame.world_from_cam for frame in frames if frame.world_from_cam is not None], place)
    said += _pose_notes(frames) + _mask_notes(frames)
    sources = tuple(by for _, by, _ in cameras)
    said += [guess_note(by) for by in sources if by != "given"]
    return Dataset(
        root,
        tuple(camera for camera, _, _ in cameras),
        tuple(frames),
        source,
        tuple(dict.fromkeys(said)),
        sources,
    )


def fitted_camera(camera: Camera, header: ImageHeader, image: GivenImage, notes: list[str]) -> Camera:
    """``camera`` for the image's true size; resized where it is one factor away, refused where it is not."""
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
