"""Poses as a file gives them, before any image file is opened."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from biresnerf.data.formats.bad_frames import said, tolerate
from biresnerf.data.model.dataset import IntrinsicsSource, SourceFormat
from biresnerf.data.photos.image_files import ImageHeader
from biresnerf.data.photos.panoramas.panorama import panorama_camera
from biresnerf.data.photos.photo_folders import few_names
from biresnerf.errors import InputError
from biresnerf.geometry.camera.camera_models import Camera


class FrameCamera(NamedTuple):
    """The camera of one image, and where it comes from.

    Attributes:
        source: who found its intrinsics.
        shared: whether other images share them, as the input says.
        notes: for the user.
        taken_with: the photo's, where the intrinsics are not given: photos that differ in it have different lenses.
    """

    camera: Camera
    source: IntrinsicsSource = "given"
    shared: bool = False
    notes: tuple[str, ...] = ()
    taken_with: tuple[str, ...] = ()


# The lens of an image by its header and name, where the pose file does not give it without them. It fits the header.
LensOf: TypeAlias = Callable[[ImageHeader, str], FrameCamera]


def panorama_lens(header: ImageHeader, name: str) -> FrameCamera:
    """`LensOf` of panoramas. Raises InputError ``camera_model_unsupported`` for a photo that is no full panorama."""
    return FrameCamera(panorama_camera(header.width, header.height, name))


@dataclass(frozen=True, eq=False)
class PoseEntry:
    """One image as a pose file describes it, before any image file is opened.

    Attributes:
        name: what the file calls it; its number where the file has no names.
        world_from_cam: float64 [4, 4], OpenCV axes; None where the file has no pose for it.
        where: the file, and the place in it, for messages.
        lens: its intrinsics, for the size that the file means, which may differ from the image's; None if unknown.
        size: width and height that the file declares where ``lens`` depends on the image; None where it does not.
        upright: whether the pose is of the photo as EXIF turns it, whatever ``size`` says.
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
    upright: bool = False
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
        InputError: the first problem, unless most of the entries and at least three are good.
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
