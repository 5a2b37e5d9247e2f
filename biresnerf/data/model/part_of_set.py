"""An image set without some of its photos."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from biresnerf.data.model.dataset import Dataset, Frame
from biresnerf.data.model.part_of_model import without_images
from biresnerf.errors import InputError

LEAST = 3  # photos that something can be made of


def without_photos(dataset: Dataset, names: Sequence[str]) -> Dataset:
    """The set without the photos of these names, as the input writes them or by their path relative to its folder.

    Lenses that no photo has any more go, too.

    Raises:
        InputError: ``left_out_not_found``, or ``too_few_images``.
    """
    if not names:
        return dataset
    row_of = {name: rows[0] for name in names if (rows := dataset.called(name))}
    unknown = [name for name in names if name not in row_of]
    if unknown:
        raise InputError(
            "left_out_not_found",
            f"there is no image {unknown[0]!r}.",
            where="leave_out",
            hint="Name images as the input does, or by their path relative to its folder.",
        )
    gone = {row_of[name] for name in names}
    kept = [frame for row, frame in enumerate(dataset.frames) if row not in gone]
    if len(kept) < LEAST:
        raise InputError(
            "too_few_images",
            f"{len(kept)} of {len(dataset)} images are left; at least {LEAST} are needed.",
            where="leave_out",
            hint="Leave out fewer.",
        )
    colmap = dataset.source.colmap
    if colmap is not None:
        colmap = without_images(colmap, {dataset.frames[row].name for row in gone})
    return with_frames(replace(dataset, source=replace(dataset.source, colmap=colmap)), kept)


def with_frames(dataset: Dataset, frames: Sequence[Frame]) -> Dataset:
    """The set with these frames in the place of its own, and without lenses that none of them has."""
    lenses = sorted({frame.camera for frame in frames})
    return replace(
        dataset,
        cameras=tuple(dataset.cameras[lens] for lens in lenses),
        frames=tuple(replace(frame, camera=lenses.index(frame.camera)) for frame in frames),
        intrinsics_sources=tuple(dataset.source_of_intrinsics(lens) for lens in lenses),
    )
