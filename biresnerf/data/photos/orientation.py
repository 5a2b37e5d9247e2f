"""EXIF orientation: whether poses mean the stored pixels or the picture as viewers turn it.

Poses and intrinsics belong to pixels. COLMAP, and what is made from its results, takes pixels as they are stored and
leaves the tag alone; other programs turn photos first. A pose file shows which by the size it names.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from biresnerf.data.model.dataset import Frame
from biresnerf.data.photos.image_files import FocalPlane, ImageHeader, read_header
from biresnerf.data.photos.photo_folders import few_names

T = TypeVar("T", bound=np.generic)
# The orientation that undoes another.
INVERSE = {1: 1, 2: 2, 3: 3, 4: 4, 5: 5, 6: 8, 7: 7, 8: 6}
# Quarter turns, clockwise, that set stored pixels upright, apart from those that are mirrored too.
_QUARTERS = {1: 0, 2: 0, 3: 2, 4: 2, 5: 1, 6: 1, 7: 3, 8: 3}


def turned_size(width: int, height: int, orientation: int) -> tuple[int, int]:
    """Width and height of a stored picture as shown: 5 to 8 exchange them."""
    return (height, width) if orientation >= 5 else (width, height)


def turned(picture: NDArray[T], orientation: int) -> NDArray[T]:
    """The stored ``picture`` [h, w, ...] as EXIF's ``orientation`` (1 to 8) shows it."""
    if orientation >= 5:
        picture = picture.swapaxes(0, 1)
    if orientation in (3, 4, 7, 8):
        picture = picture[::-1]
    if orientation in (2, 3, 6, 7):
        picture = picture[:, ::-1]
    return np.ascontiguousarray(picture)


def shown_from_stored(orientation: int) -> NDArray[np.float64]:
    """Motion [4, 4] from the camera of the stored pixels to the upright one; mirroring is left out."""
    quarter = np.array([[0.0, -1, 0, 0], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
    return np.linalg.matrix_power(quarter, _QUARTERS[orientation])


def shown_from_cam(frames: Sequence[Frame]) -> NDArray[np.float64]:
    """Motions [n, 4, 4] from each frame's camera to that of its photo as viewers show it."""
    turns = [f.orientation == 1 and read_header(f.path, f.name).orientation for f in frames]
    return np.stack([shown_from_stored(turn or 1) for turn in turns])


def turned_header(header: ImageHeader, orientation: int) -> ImageHeader:
    """The header of the picture as turned by ``orientation``."""
    if orientation == 1:
        return header
    width, height = turned_size(header.width, header.height, orientation)
    plane = header.focal_plane
    if plane is not None and orientation >= 5:
        plane = FocalPlane(plane.px_per_mm_y, plane.px_per_mm_x, plane.height, plane.width)
    return header._replace(width=width, height=height, orientation=1, focal_plane=plane, maker_lens=None)


def meant_orientations(
    headers: Sequence[ImageHeader], declared: Sequence[tuple[float | None, float | None]]
) -> list[int]:
    """The orientation to turn each stored picture by, to get the pixels that poses and intrinsics mean.

    That is 1, stored pixels, unless the ``declared`` width and height have the shape of the turned picture and not
    of the stored one. Where the set has such photos, and none that is meant as stored against its tag, whoever
    wrote it turned all of them, also those whose shape does not show it (half turns, square pictures).
    """
    verdicts = [_orientation_by_shape(header, *size) for header, size in zip(headers, declared, strict=True)]
    all_turned = "turned" in verdicts and "stored" not in verdicts
    return [
        header.orientation if verdict == "turned" or (verdict is None and all_turned) else 1
        for header, verdict in zip(headers, verdicts, strict=True)
    ]


def same_shape(width: float, height: float, other_width: float, other_height: float) -> bool:
    """Whether one is a resized copy of the other, within one pixel of rounding."""
    off = min(
        abs(height * other_width / width - other_height), abs(width * other_height / height - other_width)
    )
    return off <= 1.0


def _orientation_by_shape(header: ImageHeader, width: float | None, height: float | None) -> str | None:
    """Which picture the declared size fits, for one that its tag turns on its side; None where it fits both."""
    if header.orientation < 5 or width is None or height is None or min(width, height) <= 0:
        return None
    stored = same_shape(width, height, header.width, header.height)
    on_its_side = same_shape(width, height, header.height, header.width)
    if stored == on_its_side:
        return None
    return "stored" if stored else "turned"


def orientation_notes(
    headers: Sequence[ImageHeader], orientations: Sequence[int], names: Sequence[str]
) -> list[str]:
    """What the user should know: which photos were turned, and which have a tag that was left alone."""
    left = [n for h, o, n in zip(headers, orientations, names, strict=True) if h.orientation != 1 and o == 1]
    done = [n for o, n in zip(orientations, names, strict=True) if o != 1]
    notes = []
    if done:
        notes.append(
            f"{few_names(done)}: turned as EXIF says; poses and intrinsics are for the photos as turned"
        )
    if left:
        notes.append(
            f"{few_names(left)}: EXIF asks viewers to turn them; poses and intrinsics are for the pixels as stored, "
            "as in COLMAP"
        )
    return notes


def page_notes(headers: Sequence[ImageHeader], names: Sequence[str]) -> list[str]:
    """A note on files of several pages or frames."""
    several = [name for header, name in zip(headers, names, strict=True) if header.several]
    return [f"{few_names(several)}: holds several pages or frames; the first is used"] if several else []
