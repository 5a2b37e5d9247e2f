"""Grey photos of 16 bits as 8-bit ones: by their full range, or by the set's own where that is small.

Cameras that count 12 bits, and thermal ones that store temperatures, use a small part of 16 bits: of 29000 to 30500,
8 bits of the full range keep six steps. One rule holds for all photos of a set, so that exposures stay comparable.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from biresnerf.data.photos.image_files import UNREADABLE, open_image, quiet_pillow

# The values that become black and white.
Levels: TypeAlias = tuple[int, int]
FULL: Levels = (0, 65535)
# Of the full range: in photos of half their contrast COLMAP finds 34 to 55 % of the matches, of a quarter 3 to 22 %.
SMALL = 0.5
# Of the set's pixels so many are darker than black, and as many brighter than white: dead pixels, hot spots.
CUT = 1e-3
_SAMPLES = 1 << 20  # values of each photo, at least, that are looked at
_DECODERS = 4


def levels_of_set(files: Sequence[Path]) -> Levels | None:
    """Black and white of these 16-bit photos if their values, but a thousandth at either end, span a small range."""
    with quiet_pillow(), ThreadPoolExecutor(_DECODERS, thread_name_prefix="levels") as pool:
        counts = sum(pool.map(_histogram, files), np.zeros(FULL[1] + 1, dtype=np.int64))
    share = np.cumsum(counts) / max(1, int(counts.sum()))
    low, high = (int(np.searchsorted(share, at)) for at in (CUT, 1 - CUT))
    return (low, high) if 0 < high - low < SMALL * FULL[1] else None


def _histogram(file: Path) -> NDArray[np.int64]:
    try:
        with open_image(file, file.name) as image:
            values = np.asarray(image).ravel()
        values = values[:: max(1, len(values) // _SAMPLES)]
        return np.bincount(values.clip(*FULL), minlength=FULL[1] + 1)
    except UNREADABLE:  # said when it is decoded for use
        return np.zeros(FULL[1] + 1, dtype=np.int64)


def as_eight_bit(values: NDArray[Any], levels: Levels | None) -> NDArray[np.uint8]:
    """Grey values of 16 bits with black and white at ``levels`` (None: the full range), rounded."""
    low, high = levels or FULL
    above = values.clip(low, high).astype(np.uint32) - low
    return ((above * 255 + (high - low) // 2) // (high - low)).astype(np.uint8)


def levels_note(levels: Levels, count: int) -> str:
    """What the user should know of photos that are shown by their own range."""
    low, high = levels
    return (
        f"{count} photos have 16 bits and use those from {low} to {high} of {FULL[1]} alone: these become black and "
        "white, in all photos alike"
    )
