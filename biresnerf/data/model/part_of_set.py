"""An image set without some of its photos."""

from __future__ import annotations

import hashlib
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from biresnerf.data.model.dataset import Dataset, Frame
from biresnerf.data.model.part_of_model import without_images
from biresnerf.errors import InputError

LEAST = 3  # photos that something can be made of
MOST_NAMED = 10
SAME = 1e-4  # rad, and a share of the set's size: poses written with few digits are the same


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


def without_copies(dataset: Dataset, keep: Sequence[str] = ()) -> Dataset:
    """The set without photos whose pictures are stored as an earlier one's, and a note that names them.

    A copy's matches with its original fit exactly, and say nothing of where anything is. Copies stay where without them
    too few photos would be left, and photos of the names ``keep`` in any case.
    """
    begins = {frame.name: _picture_begins(frame.path) for frame in dataset.frames}
    size = {frame.name: frame.path.stat().st_size - begins[frame.name] for frame in dataset.frames}
    several = Counter(size.values())
    first: dict[bytes, str] = {}
    copies: dict[str, str] = {}
    for frame in sorted(dataset.frames, key=lambda frame: frame.name not in keep):
        if several[size[frame.name]] > 1:
            with frame.path.open("rb") as file:
                file.seek(begins[frame.name])
                original = first.setdefault(hashlib.file_digest(file, "sha256").digest(), frame.name)
            if original != frame.name and frame.name not in keep:
                copies[frame.name] = original
    if not copies or len(dataset) - len(copies) < LEAST:
        return dataset
    part = without_photos(dataset, tuple(copies))
    named = [f"{copy} (of {original})" for copy, original in copies.items()]
    listed = ", ".join(named[:MOST_NAMED]) + (
        f" and {len(named) - MOST_NAMED} more" * (len(named) > MOST_NAMED)
    )
    note = (
        f"{len(copies)} of {len(dataset)} photos are copies of others, and are left out, as they tell nothing new: "
        f"{listed}. A copy's pose is its original's.{_other_poses(dataset, copies)}"
    )
    return replace(part, warnings=(*part.warnings, note))


def _other_poses(dataset: Dataset, copies: Mapping[str, str]) -> str:
    """A sentence on copies that the input gives other poses than their originals: two for one picture."""
    pose_of = {frame.name: frame.world_from_cam for frame in dataset.frames}
    places = np.array([pose[:3, 3] for pose in pose_of.values() if pose is not None]).reshape(-1, 3)
    size = float(np.ptp(places, axis=0).max(initial=0.0)) if len(places) else 0.0
    apart = []
    for copy, original in copies.items():
        pose, other = pose_of[copy], pose_of[original]
        if pose is None or other is None:
            continue
        moved = float(np.linalg.norm(pose[:3, 3] - other[:3, 3]))
        if moved > SAME * size or not np.allclose(pose[:3, :3], other[:3, :3], rtol=0, atol=SAME):
            apart.append(copy)
    if not apart:
        return ""
    named = ", ".join(apart[:MOST_NAMED]) + f" and {len(apart) - MOST_NAMED} more" * (len(apart) > MOST_NAMED)
    return (
        f" The input has other poses for {named} than for the same pictures under their other names; these were not "
        "used. Is each file the photo that its pose was given for?"
    )


def _picture_begins(path: Path) -> int:
    """Where a JPEG's picture begins, behind metadata that programs add or change; 0 in other files."""
    with path.open("rb") as file:
        if file.read(2) != b"\xff\xd8":
            return 0
        while (head := file.read(4))[:1] == b"\xff" and (length := int.from_bytes(head[2:], "big")) >= 2:
            if head[1] == 0xDA:  # start of scan
                return file.tell() - len(head)
            file.seek(length - 2, 1)
    return 0
