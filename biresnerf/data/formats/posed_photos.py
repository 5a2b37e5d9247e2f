"""Photos of poses as their files are: which can be read, how they are turned, and the lens of each at its size."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from biresnerf.data.formats.bad_frames import attempt, good_frames
from biresnerf.data.formats.parsed_poses import FrameCamera, PoseEntry, panorama_lens
from biresnerf.data.photos.guessed_lens import guess_lens, lens_doubts, refuse_other_units
from biresnerf.data.photos.image_files import ImageHeader, read_header
from biresnerf.data.photos.kinds.sixteen_bit import Levels, levels_note, levels_of_set
from biresnerf.data.photos.orientation import (
    meant_orientations,
    orientation_notes,
    page_notes,
    same_shape,
    turned_header,
)
from biresnerf.errors import InputError
from biresnerf.geometry.camera.camera_models import Camera


@dataclass(frozen=True, eq=False)
class PosedPhotos:
    """The good ones of a set's photos, each with its entry.

    Attributes:
        images: file and entry of each.
        lenses: at the size of the file, as turned.
        orientations: EXIF orientation by which each is turned first.
        levels: black and white of each, for those of 16 bits where the set's are not the full range.
        notes: for the user: what was left out, and what was done.
    """

    images: tuple[tuple[Path, PoseEntry], ...]
    lenses: tuple[FrameCamera, ...]
    orientations: tuple[int, ...]
    levels: tuple[Levels | None, ...]
    notes: tuple[str, ...]


def read_photos(images: Sequence[tuple[Path, PoseEntry]], *, strict: bool) -> PosedPhotos:
    """The photos with the lenses of their entries; reads the files' headers.

    Raises:
        InputError: ``mixed_sizes``, or the code of the first bad photo by the rule of `tolerate`.
    """
    names = [entry.name for _, entry in images]
    read = [attempt(partial(read_header, path, entry.name)) for path, entry in images]
    stored, kept, dropped = good_frames(read, names, strict=strict)
    images = [images[index] for index in kept]
    shown = meant_orientations(stored, [_declared_size(entry) for _, entry in images])
    turns = [
        header.orientation if entry.upright else turn
        for (_, entry), header, turn in zip(images, stored, shown, strict=True)
    ]
    headers = [turned_header(header, turn) for header, turn in zip(stored, turns, strict=True)]
    lenses = [
        attempt(partial(_sound_camera, entry, header))
        for (_, entry), header in zip(images, headers, strict=True)
    ]
    found, kept, more = good_frames(lenses, [entry.name for _, entry in images], strict=strict)
    images, stored, turns = [images[i] for i in kept], [stored[i] for i in kept], [turns[i] for i in kept]
    entries = [entry for _, entry in images]
    names = [entry.name for entry in entries]
    _refuse_mixed_sizes(found, entries)
    deep = [path for (path, _), header in zip(images, stored, strict=True) if header.sixteen_bit]
    levels = levels_of_set(deep) if deep else None
    notes = [*dropped, *more, *orientation_notes(stored, turns, names), *page_notes(stored, names)]
    if levels is not None:
        notes.append(levels_note(levels, len(deep)))
    each = tuple(levels if header.sixteen_bit else None for header in stored)
    return PosedPhotos(tuple(images), tuple(found), tuple(turns), each, tuple(notes))


def _declared_size(entry: PoseEntry) -> tuple[float | None, float | None]:
    return (entry.lens.width, entry.lens.height) if isinstance(entry.lens, Camera) else entry.size


def _sound_camera(entry: PoseEntry, header: ImageHeader) -> FrameCamera:
    """The entry's camera, if its photo is no panorama and its numbers are those of a lens, with notes on doubts.

    Raises:
        InputError: ``camera_model_unsupported``, ``intrinsics_invalid``, or a code of `_camera_of`.
    """
    found = _camera_of(entry, header)
    if found.camera.panorama:
        return found
    # Views that were cut from a panorama may still say that they are one: they are no 2 : 1, or have a lens.
    if header.equirectangular and (found.source != "given" or header.width == 2 * header.height):
        return panorama_lens(header, entry.name)._replace(source="exif")
    if found.source != "given":
        found = found._replace(taken_with=header.taken_with)
        if header.width != 2 * header.height:
            return found
        note = (
            "photos twice as wide as high may be panoramas, and are taken for perspective ones: if they are, set "
            "panoramas=all"
        )
        return found._replace(notes=(*found.notes, note))
    refuse_other_units(found.camera, entry.where)
    return found._replace(notes=(*found.notes, *lens_doubts(found.camera, header)))


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
