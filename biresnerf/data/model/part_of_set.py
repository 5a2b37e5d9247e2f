"""An image set, or a COLMAP model, without some of its photos."""

from __future__ import annotations

from collections.abc import Sequence, Set
from dataclasses import replace

import numpy as np

from biresnerf.data.model.colmap_scene import ColmapModel
from biresnerf.data.model.dataset import Dataset, Frame
from biresnerf.data.model.result_model import with_points
from biresnerf.errors import InputError

LEAST = 3  # photos of a usable set


def without_photos(dataset: Dataset, names: Sequence[str], only: Sequence[str] = ()) -> Dataset:
    """The set without the photos of these names; of those in ``only`` alone, where it names any.

    Names are as the input writes them, or paths relative to its folder. Lenses that no photo has any more go, too.

    Raises:
        InputError: ``photos_not_found``, ``left_out_not_found``, or ``too_few_images``.
    """
    gone = _rows(dataset, names, "left_out_not_found", "leave_out")
    if only:
        gone |= set(range(len(dataset))) - _rows(dataset, only, "photos_not_found", "photos")
    if not gone:
        return dataset
    kept = [frame for row, frame in enumerate(dataset.frames) if row not in gone]
    if len(kept) < LEAST:
        raise InputError(
            "too_few_images",
            f"{len(kept)} of {len(dataset)} images are left; at least {LEAST} are needed.",
            where="photos" if only else "leave_out",
            hint="Name more photos." if only else "Leave out fewer.",
        )
    colmap = dataset.source.colmap
    if colmap is not None:
        colmap = without_images(colmap, {dataset.frames[row].name for row in gone})
    return with_frames(replace(dataset, source=replace(dataset.source, colmap=colmap)), kept)


def _rows(dataset: Dataset, names: Sequence[str], code: str, where: str) -> set[int]:
    """The rows of the photos of these names."""
    row_of = {name: rows[0] for name in names if (rows := dataset.called(name))}
    unknown = [name for name in names if name not in row_of]
    if unknown:
        raise InputError(
            code,
            f"there is no image {unknown[0]!r}.",
            where=where,
            hint="Name images as the input does, or by their path relative to its folder.",
        )
    return set(row_of.values())


def with_frames(dataset: Dataset, frames: Sequence[Frame]) -> Dataset:
    """The set with these frames in the place of its own, and without lenses that none of them has."""
    lenses = sorted({frame.camera for frame in frames})
    return replace(
        dataset,
        cameras=tuple(dataset.cameras[lens] for lens in lenses),
        frames=tuple(replace(frame, camera=lenses.index(frame.camera)) for frame in frames),
        intrinsics_sources=tuple(dataset.source_of_intrinsics(lens) for lens in lenses),
    )


def without_images(model: ColmapModel, names: Set[str]) -> ColmapModel:
    """The model without the images of these names: out of its tracks, points and frames, too.

    Points that nothing sees any more go, and frames that hold no image any more.
    """
    gone = {image.id for image in model.images.values() if image.name in names}
    if not gone:
        return model
    points = model.points
    stays = ~np.isin(points.track_image_ids, list(gone))
    lengths = np.bincount(points.owner[stays], minlength=len(points))
    # A point that had no track to begin with loses nothing.
    kept = points.only((lengths > 0) | (np.diff(points.track_starts) == 0), stays)
    frames = {}
    for number, frame in model.frames.items():
        data = tuple(one for one in frame.data_ids if one[0][0] != "CAMERA" or one[1] not in gone)
        if any(sensor[0] == "CAMERA" for sensor, _ in data):
            frames[number] = replace(frame, data_ids=data)
    images = {number: image for number, image in model.images.items() if number not in gone}
    return with_points(replace(model, images=images, frames=frames), kept)
