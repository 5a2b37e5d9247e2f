"""How parsed poses are bound to image files to make a dataset: which file each means, and its lens at that size."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

from biresnerf.data.formats.bad_frames import attempt, good_frames, missing_images
from biresnerf.data.formats.match_names import EXPECTED, match_files
from biresnerf.data.formats.parsed_poses import Assignment, FrameCamera, ParsedPoses, PoseEntry, panorama_lens
from biresnerf.data.model.dataset import Dataset, Frame, IntrinsicsSource, SourceFormat
from biresnerf.data.model.image_order import names_of_poses, natural_key
from biresnerf.data.model.pose_validation import refuse_coinciding
from biresnerf.data.photos.guessed_lens import guess_lens, guess_note, lens_doubts, refuse_other_units
from biresnerf.data.photos.image_files import ImageHeader, read_header
from biresnerf.data.photos.kinds.sixteen_bit import Levels, levels_note, levels_of_set
from biresnerf.data.photos.masks import mask_beside, mask_notes
from biresnerf.data.photos.named_images import refuse_more_than_files, refuse_outside, refuse_too_few
from biresnerf.data.photos.orientation import (
    meant_orientations,
    orientation_notes,
    page_notes,
    same_shape,
    turned_header,
)
from biresnerf.data.photos.photo_folders import (
    few_names,
    photos_beside,
    photos_named,
    refuse_no_images,
    unused_image_notes,
    with_named,
)
from biresnerf.data.photos.shear import shear_notes
from biresnerf.errors import InputError
from biresnerf.geometry.camera.camera_models import Camera


def bind_images(parsed: ParsedPoses, root: Path, within: Path | None = None) -> Dataset:
    """The dataset of parsed poses and the images in or below ``root``.

    Args:
        within: refuse files outside of this folder; for uploaded sets.

    Raises:
        InputError: ``no_images``, ``image_missing``, ``pose_count_mismatch`` or a code of `dataset_of`.
    """
    named = parsed.assign is None
    if named and within is not None:
        refuse_more_than_files(parsed.source.files[0].name, len(parsed.entries), within)
    files = photos_beside(root, parsed.photo_folders)
    if named and not files:
        files = photos_named(root, [entry.name for entry in parsed.entries])
    files = with_named(files, root, (entry.name for entry in parsed.entries)) if named else files
    refuse_no_images(files, root)
    names = sorted(files, key=natural_key)
    assign = parsed.assign or partial(by_name, parsed.entries, strict=parsed.strict)
    pairs, notes = assign(names)
    if parsed.take_file_names:
        notes = [note for note in notes if not any(words in note for words in EXPECTED)]
        pairs = [(name, replace(entry, name=name)) for name, entry in pairs]
    images = [(files[name], entry) for name, entry in pairs]
    dataset = dataset_of(root, images, parsed.source, [*parsed.notes, *notes], within, strict=parsed.strict)
    masks = [frame.mask for frame in dataset.frames if frame.mask is not None]
    beside = unused_image_notes([path for path, _ in images], masks) if named else []
    return replace(dataset, warnings=(*dataset.warnings, *beside))


def by_name(entries: Sequence[PoseEntry], names: Sequence[str], *, strict: bool = False) -> Assignment:
    """Each entry with the image file of its name; those whose file is missing are left out where most are there.

    Raises:
        InputError: ``image_missing``.
    """
    found, notes = match_files([entry.name for entry in entries], names)
    missing = {entry.name: entry.where for entry in entries if entry.name not in found}
    hint = "Put the images into images/ under the names that the poses are given for."
    where = next(iter(missing.values()), "")
    notes += missing_images([*missing], len(entries), where, hint, strict=strict)
    return [(found[entry.name], entry) for entry in entries if entry.name in found], notes


def in_order(
    entries: Sequence[PoseEntry], names: Sequence[str], file: str, hint: str, *, as_text: bool = False
) -> Assignment:
    """The entries with the images in the order of their names, as `names_of_poses` finds it.

    Raises:
        InputError: ``pose_count_mismatch``.
    """
    if len(names) != len(entries):
        detail = f"has {len(entries)} poses for {len(names)} images, and does not say which belongs to which."
        raise InputError("pose_count_mismatch", detail, where=file, hint=hint)
    ordered, note = names_of_poses(names, [entry.world_from_cam for entry in entries], as_text=as_text)
    pairs = [(name, replace(entry, name=name)) for name, entry in zip(ordered, entries, strict=True)]
    return pairs, [f"{file}: images were taken in the order of their names" + (note and f"; {note}")]


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
    if within is not None:
        refuse_outside([path for path, _ in images], [entry.name for _, entry in images], within, place)
    photos = read_photos(images, strict=strict)
    cameras: dict[tuple[Camera, IntrinsicsSource, int | None, tuple[str, ...]], int] = {}
    frames = []
    for (path, entry), lens, orientation, levels in zip(
        photos.images, photos.lenses, photos.orientations, photos.levels, strict=True
    ):
        index = cameras.setdefault((lens.camera, lens.source, entry.camera_id, lens.taken_with), len(cameras))
        mask, inverted = entry.mask or mask_beside(root, path, entry.name, within)
        frames.append(
            Frame(
                entry.name, path, index, entry.world_from_cam,
                None if entry.world_from_cam is None else "given", entry.raw, mask=mask, mask_inverted=inverted,
                orientation=orientation, timestamp_s=entry.timestamp_s, levels=levels,
            )
        )  # fmt: skip
    refuse_coinciding([frame.world_from_cam for frame in frames if frame.world_from_cam is not None], place)
    # A folder of images alone never has poses or intrinsics.
    missing = _missing_notes(frames, photos, table or "images") if source.files else []
    lens_notes = [note for lens in photos.lenses for note in lens.notes]
    lens_notes += shear_notes([lens.camera for lens in photos.lenses])
    return Dataset(
        root,
        tuple(camera for camera, *_ in cameras),
        tuple(frames),
        source,
        tuple(dict.fromkeys([*notes, *photos.notes, *lens_notes, *missing, *mask_notes(root, frames)])),
        tuple(by for _, by, *_ in cameras),
    )


def _missing_notes(frames: Sequence[Frame], photos: PosedPhotos, table: str) -> list[str]:
    """Notes on frames without a pose, and on guessed lenses."""
    without = [frame.name for frame in frames if frame.world_from_cam is None]
    guesses = (lens.source for lens in photos.lenses if lens.source != "given" and not lens.camera.panorama)
    notes = [guess_note(source) for source in guesses]
    if without:
        notes.insert(0, f"{len(without)} of {len(frames)} {table} have no pose yet: {few_names(without)}")
    return notes


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
