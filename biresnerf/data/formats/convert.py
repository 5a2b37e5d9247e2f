"""A set written in other formats at the poses it has, each where programs look for it, with the photos beside."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath
from typing import Literal

from biresnerf.data.formats.codec import WriteContext, cannot_hold
from biresnerf.data.formats.registry import ALL_CODECS
from biresnerf.data.formats.transforms.write_intrinsics import lens_values
from biresnerf.data.formats.transforms.write_transforms import transforms_notes
from biresnerf.data.formats.write_each import write_each
from biresnerf.data.model.atomic_file import whole_folder, write_json
from biresnerf.data.model.dataset import Dataset
from biresnerf.data.model.refined_set import RefinedSet, refined_set
from biresnerf.data.photos.masks import mask_beside
from biresnerf.data.photos.photo_folders import IMAGE_FOLDER
from biresnerf.data.points.refined_points import with_given_points
from biresnerf.data.show.renders import picture_stems
from biresnerf.errors import InputError
from biresnerf.options.formats import Loss, formats

Photos = Literal["link", "copy", "none"]
CAMERA = "camera.json"


@dataclass(frozen=True)
class Written:
    """What a conversion did: the file or folder of each format, images left out for lack of a pose, and notes."""

    places: dict[str, Path]
    left_out: tuple[str, ...]
    notes: tuple[str, ...]


def convert(
    dataset: Dataset,
    names: Sequence[str],
    folder: Path,
    photos: Photos = "link",
    bounds: tuple[float, float] | None = None,
) -> Written:
    """Writes the set into ``folder`` (new, or empty) in each of the formats; nothing is optimised.

    Images without a pose are left out.

    Args:
        photos: whether images and masks are linked or copied there, under the names that they have in the set's folder.
        bounds: nearest and farthest depth, for LLFF; default: those of the points that each image sees.

    Raises:
        InputError: ``no_poses``, ``export_not_possible``: a format cannot hold this set; ``bounds_missing``.
    """
    posed = [frame for frame in dataset.frames if frame.world_from_cam is not None]
    left_out = tuple(frame.name for frame in dataset.frames if frame.world_from_cam is None)
    if not posed:
        raise InputError(
            "no_poses",
            "holds no poses to convert.",
            where=str(dataset.root),
            hint="Find them with `biresnerf refine`.",
        )
    chosen = replace(dataset, frames=tuple(posed))
    refined = refined_set(chosen, chosen.world_from_cam)
    if dataset.source.colmap is not None:
        refined = with_given_points(refined, dataset.source.colmap)
    flat = refined
    if photos != "none" and any(map(_wants_flat, names)):
        flat = _in_images_folder(refined)
        _refuse_two_names(refined, flat, names)
    with whole_folder(folder) as staging:
        context = WriteContext(chosen, bounds)
        writing = write_each(refined, names, lambda name: _write(flat, refined, name, staging, context))
        writing.raise_first()
        names = writing.written
        if any("lens file" in formats()[name].needs for name in names) and len(chosen.cameras) == 1:
            write_json(staging / CAMERA, lens_values(chosen.cameras[0]))
        if photos != "none":
            if flat is not refined:
                moved = zip(posed, flat.images, strict=True)
                _transfer([(frame.path, staging / image.file_name) for frame, image in moved], photos)
            _transfer_photos(chosen, staging, photos, without_images=all(map(_wants_flat, names)))
    places = {name: folder / formats()[name].in_set for name in names}
    return Written(places, left_out, (*writing.notes, *_notes(chosen, names)))


def _write(flat: RefinedSet, refined: RefinedSet, name: str, folder: Path, context: WriteContext) -> None:
    codec = ALL_CODECS[name]
    codec.write_set(flat if _wants_flat(name) else refined, folder / codec.format.in_set, context)


def _notes(dataset: Dataset, names: Sequence[str]) -> tuple[str, ...]:
    notes = transforms_notes(dataset, dataset.world_from_cam) if "transforms" in names else ()
    bare = [name for name in names if "lens file" in formats()[name].needs]
    if bare and len(dataset.cameras) > 1:
        notes += (f"{' and '.join(bare)} know no lenses, and {CAMERA} can only hold one: none was written.",)
    return notes + _mask_notes(dataset, names)


def _mask_notes(dataset: Dataset, names: Sequence[str]) -> tuple[str, ...]:
    """Formats that cannot name masks have those at masks/NAME.png, where readers look for them."""

    def losing(loss: Loss) -> str:
        return ", ".join(name for name in names if loss in formats()[name].loses)

    masked = [frame for frame in dataset.frames if frame.mask is not None]
    notes = []
    if masked and losing("masks"):
        notes.append(f"{losing('masks')} has no masks: they do not fit its undistorted photos.")
    lost = sum(mask_beside(dataset.root, frame.path, frame.name)[0] != frame.mask for frame in masked)
    if lost and losing("mask paths"):
        verb = "name" if "," in losing("mask paths") else "names"
        notes.append(
            f"{losing('mask paths')} {verb} no masks: {lost} of them are not at masks/NAME.png, where readers look."
        )
    return tuple(notes)


def _wants_flat(name: str) -> bool:
    return "images folder" in formats()[name].needs


def _in_images_folder(refined: RefinedSet) -> RefinedSet:
    """The set with all photos directly in images/: by their file names, with their folders where two share one."""
    names = [PurePosixPath(image.file_name) for image in refined.images]
    flat = [name.name for name in names]
    if len({name.casefold() for name in flat}) < len(flat):
        stems = picture_stems([str(name).removeprefix(f"{IMAGE_FOLDER}/") for name in names])
        flat = [stem + name.suffix for stem, name in zip(stems, names, strict=True)]
    images = [
        replace(image, file_name=f"{IMAGE_FOLDER}/{name}")
        for image, name in zip(refined.images, flat, strict=True)
    ]
    return replace(refined, images=tuple(images))


def _refuse_two_names(refined: RefinedSet, flat: RefinedSet, names: Sequence[str]) -> None:
    """Raises InputError where one format needs a photo under a name by which another's readers would not find it."""
    if all(map(_wants_flat, names)):
        return
    for image, moved in zip(refined.images, flat.images, strict=True):
        old, new = PurePosixPath(image.file_name), PurePosixPath(moved.file_name)
        found_by_its_name = old.name == new.name and old.parts[0] != IMAGE_FOLDER
        if old != new and not found_by_its_name:
            raise cannot_hold(
                ", ".join(names),
                f"{old} must be {new} for one of the formats, and keep its name for another.",
                f"Convert to {', '.join(filter(_wants_flat, names))} in a folder of its own.",
            )


def _transfer_photos(
    dataset: Dataset, folder: Path, how: Literal["link", "copy"], *, without_images: bool = False
) -> None:
    """Photos (but ``without_images``) and masks, at the places that they have in the set's folder."""
    files = set() if without_images else {frame.path for frame in dataset.frames}
    files |= {frame.mask for frame in dataset.frames if frame.mask is not None}
    pairs = []
    for file in sorted(files):
        name = Path(os.path.relpath(file, dataset.root))
        if ".." in name.parts:
            raise InputError(
                "image_outside",
                "lies outside the set's folder and cannot be copied with it.",
                where=str(file),
                hint="Leave photos where they are: --photos none.",
            )
        pairs.append((file, folder / name))
    _transfer(pairs, how)


def _transfer(files: Iterable[tuple[Path, Path]], how: Literal["link", "copy"]) -> None:
    for file, target in files:
        if target.is_symlink() or target.exists():
            continue  # it lies in images/ in its own folder, too
        target.parent.mkdir(parents=True, exist_ok=True)
        if how == "link":
            target.symlink_to(file.resolve())
        else:
            shutil.copyfile(file, target)
