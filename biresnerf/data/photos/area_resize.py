"""Exact area averaging: every output pixel is the mean of the part of the picture that it covers."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

_AT_ONCE = 1 << 22  # values; larger pictures would take much memory as floats


def _floats(picture: NDArray[np.generic]) -> NDArray[np.float32]:
    return picture.astype(np.float32)


def _shrink_rows(
    picture: NDArray[np.generic], rows: int, values: Callable[[NDArray], NDArray[np.float32]] = _floats
) -> NDArray[np.float32]:
    """[h, ...] -> float32 [rows, ...]; fractional rows count by the fraction covered."""
    height = picture.shape[0]
    if height == 2 * rows and picture.size <= _AT_ONCE:  # as in pyramids; the same without a loop
        return (values(picture[::2]) + values(picture[1::2])) / np.float32(2)
    result = np.empty((rows, *picture.shape[1:]), dtype=np.float32)
    edges = np.arange(rows + 1) * (height / rows)
    for row in range(rows):
        low, high = edges[row], min(edges[row + 1], float(height))
        first, last = int(low), min(int(np.ceil(high)), height)
        index = np.arange(first, last)
        weights = np.minimum(index + 1, high) - np.maximum(index, low)
        weights = (weights / weights.sum()).astype(np.float32)
        result[row] = np.tensordot(weights, values(picture[first:last]), axes=1)
    return result


def area_resize(
    picture: NDArray[np.generic],
    width: int,
    height: int,
    values: Callable[[NDArray], NDArray[np.float32]] = _floats,
) -> NDArray[np.float32]:
    """``picture`` [h, w, c] averaged down to float32 [height, width, c], same range of values.

    ``values`` are what is averaged, of some rows of the picture [rows, w, c] at a time: all of a large one would take
    much memory.

    Sizes must not exceed the picture's. Resampling filters that weigh whole pixels (Pillow's BOX) shift
    content by up to half a source pixel where the ratio is no integer, which would bias camera poses.
    """
    if not (0 < height <= picture.shape[0] and 0 < width <= picture.shape[1]):
        raise ValueError(f"cannot average {picture.shape[1]} x {picture.shape[0]} px to {width} x {height}")
    if (height, width) == picture.shape[:2]:
        return values(picture)
    tall = _shrink_rows(picture, height, values)
    return np.ascontiguousarray(_shrink_rows(tall.swapaxes(0, 1), width).swapaxes(0, 1))
