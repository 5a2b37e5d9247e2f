"""How parsed poses are bound to image files to make a dataset."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

from biresnerf.data.formats.bad_frames import tolerate
from biresnerf.data.formats.match_names import EXPECTED, match_files
from biresnerf.data.formats.parsed_poses import Assignment, ParsedPoses, PoseEntry
from biresnerf.data.formats.posed_photos import PosedPhotos, read_photos
from biresnerf.data.model.dataset import Dataset, Frame, IntrinsicsSource, SourceFormat
from biresnerf.data.model.image_order import names_of_poses, natural_key
from biresnerf.data.model.pose_validation import refuse_coinciding
from biresnerf.data.photos.guessed_lens import guess_note
from biresnerf.data.photos.masks import mask_beside, mask_notes
from biresnerf.data.photos.named_images import refuse_more_than_files, refuse_outside, refuse_too_few
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
