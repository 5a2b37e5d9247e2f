"""Photos that are there twice: the same file, the same picture with other metadata, or compressed again."""

from __future__ import annotations

import hashlib
from collections import Counter
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from biresnerf.data.model.dataset import Dataset, Frame
from biresnerf.data.model.part_of_set import LEAST, without_photos
from biresnerf.data.photos.image_files import (
    EXIF_ORIENTATION,
    UNREADABLE,
    from_exif,
    is_sixteen_bit,
    open_image,
    quiet_pillow,
)
from biresnerf.data.photos.orientation import turned, turned_size
from biresnerf.data.photos.photo_folders import few_names
from biresnerf.geometry.pose_error import rotation_between_deg

MOST_NAMED = 10
SAME = 1e-4  # rad, and a share of the set's size: poses written with few digits are the same
# Pictures are compared in so many cells a side, of grey levels to 255.
SIDE, FINE = 64, 4  # cells, and samples along each
LEAST_PX = SIDE * FINE  # of the long side
MOST_PX = 4_000_000  # of a picture that cannot be decoded at a part of its size, as a JPEG can
# Pictures compressed again differ by less, and those whose camera moved by more (docs/input.md): root mean square in
# that of the steps between cells, and the largest mean of 4 x 4 cells, in which alone something may have moved.
MOST_MOVED, MOST_APART, BLOCK = 0.06, 2.0, 4
ASPECT = 0.01  # of width by height, which halving an odd number changes
# Poses given for one picture: by how much they may be apart, the second as a share of the set's size.
SAME_VIEW_DEG, SAME_VIEW = 0.5, 0.01
_COARSE = 8  # cells of a side, whose means distinguish most pictures
_DECODERS = 4


def without_copies(dataset: Dataset, keep: Sequence[str] = ()) -> Dataset:
    """The set without photos whose pictures are those of others, and a note that names them.

    A copy's matches with its original fit exactly, and say nothing of where anything is. Of equal pictures the one with
    a pose stays, then the larger one, then the earlier. Copies stay where without them too few photos would be left,
    and photos of the names ``keep`` in any case.
    """
    copies = _stored_alike(dataset, keep)
    again = _compressed_again(dataset, [f for f in dataset.frames if f.name not in copies], keep)
    # The original of a copy may be a copy itself.
    copies = {copy: again.get(original, original) for copy, original in (copies | again).items()}
    if not copies or len(dataset) - len(copies) < LEAST:
        return dataset
    part = without_photos(dataset, tuple(copies))
    named = [
        f"{copy} (of {original}{', compressed again' if copy in again else ''})"
        for copy, original in copies.items()
    ]
    note = (
        f"{len(copies)} of {len(dataset)} photos are copies of others, and are left out, as they tell nothing new: "
        f"{few_names(named, MOST_NAMED)}. A copy's pose is its original's.{_other_poses(dataset, copies)}"
    )
    return replace(part, warnings=(*part.warnings, note))


def _stored_alike(dataset: Dataset, keep: Sequence[str]) -> dict[str, str]:
    """Photos whose pictures are stored byte for byte as another's, by name, with that one."""
    begins = {frame.name: _picture_begins(frame.path) for frame in dataset.frames}
    size = {frame.name: frame.path.stat().st_size - begins[frame.name] for frame in dataset.frames}
    several = Counter(size.values())
    first: dict[bytes, str] = {}
    copies: dict[str, str] = {}
    for frame in sorted(
        dataset.frames, key=lambda frame: (frame.name not in keep, frame.world_from_cam is None)
    ):
        if several[size[frame.name]] > 1:
            with frame.path.open("rb") as file:
                file.seek(begins[frame.name])
                original = first.setdefault(hashlib.file_digest(file, "sha256").digest(), frame.name)
            if original != frame.name and frame.name not in keep:
                copies[frame.name] = original
    return copies


@dataclass(frozen=True, eq=False)
class _Picture:
    """A photo as viewers show it in 64 x 64 cells, with the root mean square of the steps between them."""

    frame: Frame
    cells: NDArray[np.float32]
    step: float
    size: tuple[int, int]

    @property
    def coarse(self) -> NDArray[np.float32]:
        return _means(self.cells, SIDE // _COARSE).ravel()

    def is_of(self, other: _Picture) -> bool:
        """Whether the two differ as pictures do that were compressed or resized again."""
        apart = np.abs(self.cells - other.cells)
        (w, h), (width, height) = self.size, other.size
        return bool(
            abs(np.log(w * height / (h * width))) < ASPECT
            and np.sqrt((apart**2).mean()) < MOST_MOVED * min(self.step, other.step)
            and _means(apart, BLOCK).max() < MOST_APART
        )


def _compressed_again(dataset: Dataset, frames: Sequence[Frame], keep: Sequence[str]) -> dict[str, str]:
    """Those of ``frames`` that show another's picture in other bytes, by name, with that one."""
    with quiet_pillow(), ThreadPoolExecutor(_DECODERS, thread_name_prefix="copies") as pool:
        pictures = [picture for picture in pool.map(_picture, frames) if picture is not None]
    pictures.sort(
        key=lambda one: (
            one.frame.name not in keep, one.frame.world_from_cam is None, -one.size[0] * one.size[1],
            -one.frame.path.stat().st_size,
        )
    )  # fmt: skip
    known = np.empty((len(pictures), _COARSE**2), np.float32)
    originals: list[_Picture] = []
    copies: dict[str, str] = {}
    extent = _extent(dataset)
    for picture in pictures:
        coarse, count = picture.coarse, len(originals)
        near = np.flatnonzero(np.abs(known[:count] - coarse).max(1, initial=0.0) < MOST_APART).tolist()
        found = next(
            (k for k in near if picture.is_of(originals[k]) and _one_view(picture, originals[k], extent)),
            None,
        )
        if found is not None and picture.frame.name not in keep:
            copies[picture.frame.name] = originals[found].frame.name
            continue
        known[count] = coarse
        originals.append(picture)
    return copies


def _picture(frame: Frame) -> _Picture | None:
    """None for pictures too small, of 16 bits or too large to be decoded for this."""
    try:
        with open_image(frame.path, frame.name) as image:
            width, height = image.size
            jpeg = image.format in ("JPEG", "MPO")
            if max(width, height) < LEAST_PX or (not jpeg and width * height > MOST_PX):
                return None
            if is_sixteen_bit(image) or image.mode.startswith(("I", "F")):
                return None
            said = from_exif(image, lambda exif: exif.get(EXIF_ORIENTATION))
            shown = said if isinstance(said, int) and 1 <= said <= 8 else 1
            drafted = image.draft("L", (LEAST_PX, LEAST_PX))
            box = (0, 0, width, height) if drafted is None else drafted[1]
            grey = image.convert("L").resize((LEAST_PX, LEAST_PX), Image.Resampling.BILINEAR, box=box)
    except UNREADABLE:
        return None  # the code that needs the picture reports what is wrong with it
    cells = turned(_means(np.asarray(grey, np.float32), FINE), shown)
    down, right = np.gradient(cells)
    step = float(np.sqrt((down**2 + right**2).mean()))
    return _Picture(frame, cells, step, turned_size(width, height, shown))


def _means(values: NDArray[np.float32], side: int) -> NDArray[np.float32]:
    """Means over squares of so many values a side."""
    rows, columns = (size // side for size in values.shape)
    return np.asarray(values.reshape(rows, side, columns, side).mean((1, 3)))


def _one_view(picture: _Picture, other: _Picture, extent: float) -> bool:
    """Whether the input allows that the two show one view; not if it has different poses, as for a vase that turned."""
    a, b = picture.frame.world_from_cam, other.frame.world_from_cam
    if a is None or b is None:
        return True
    moved = float(np.linalg.norm(a[:3, 3] - b[:3, 3]))
    return moved <= SAME_VIEW * extent and float(rotation_between_deg(a[None], b[None])[0]) <= SAME_VIEW_DEG


def _extent(dataset: Dataset) -> float:
    """The longest side of the box around the cameras."""
    places = [frame.world_from_cam[:3, 3] for frame in dataset.frames if frame.world_from_cam is not None]
    return float(np.ptp(np.array(places), axis=0).max()) if places else 0.0


def _other_poses(dataset: Dataset, copies: Mapping[str, str]) -> str:
    """A sentence on copies that the input gives other poses than their originals: two for one picture."""
    pose_of = {frame.name: frame.world_from_cam for frame in dataset.frames}
    size = _extent(dataset)
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
    return (
        f" The input has other poses for {few_names(apart, MOST_NAMED)} than for the same pictures under their "
        "other names; these were not used. Is each file the photo that its pose was given for?"
    )


def _picture_begins(path: Path) -> int:
    """Where a JPEG's picture begins, after metadata that programs add or change; 0 in other files."""
    with path.open("rb") as file:
        if file.read(2) != b"\xff\xd8":
            return 0
        while (head := file.read(4))[:1] == b"\xff" and (length := int.from_bytes(head[2:], "big")) >= 2:
            if head[1] == 0xDA:  # start of scan
                return file.tell() - len(head)
            file.seek(length - 2, 1)
    return 0
