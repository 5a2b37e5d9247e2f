"""Which frames of a video are worth having: sharp ones, evenly spread over the camera's path and not over time."""

from __future__ import annotations

from functools import cache

import numpy as np
from numpy.typing import NDArray

SIDE = 480  # px, long side at which frames are compared
_BLOCK = 60  # px of a block that moves as one, in frames of half the size
_ANEW = 10  # px, half size: after so much motion a new frame is the reference, well below half a block
_TEXTURE = 3.0  # of 255: a block that varies less says nothing of motion
_STANDS_STILL = 4.0  # px, half size: a camera that moved less in all stood still
_OFF_CENTRE = 0.25  # of its sharpness a frame at the edge of its stretch loses against one in the middle


class FrameWatch:
    """Looks at one frame after the other, uint8 [h, w] at `SIDE`, and keeps a few numbers of each.

    Attributes:
        sharpness: mean square of the Laplacian, which blur takes away.
        travelled: px that the picture has moved by since the first frame, in sum.
    """

    def __init__(self) -> None:
        self.sharpness, self.travelled = list[float](), list[float]()
        self._reference: NDArray[np.complex64] | None = None
        self._telling = np.zeros(0, dtype=np.bool_)
        self._before = 0.0

    def look(self, frame: NDArray[np.uint8]) -> None:
        """Look at the next frame."""
        values = frame.astype(np.float32)
        self.sharpness.append(_laplacian(values))
        blocks = _blocks(_halved(values))
        spectrum = np.fft.rfft2(blocks * _window(blocks.shape[1])).astype(np.complex64)
        if self._reference is None or self._reference.shape != spectrum.shape:
            self._refer(spectrum, blocks)
        shift = _shift(self._reference, spectrum, self._telling)
        self.travelled.append(self._before + shift)
        if shift > _ANEW:
            self._before += shift
            self._refer(spectrum, blocks)

    def _refer(self, spectrum: NDArray[np.complex64], blocks: NDArray[np.float32]) -> None:
        self._reference, self._telling = spectrum, blocks.std(axis=(1, 2)) > _TEXTURE


def choose_frames(
    times_s: NDArray[np.float64], sharpness: NDArray[np.float64], travelled: NDArray[np.float64], count: int
) -> list[int]:
    """Indices of ``count`` of the frames [n], or of fewer where there are no more, in their order.

    The camera's path is cut into stretches of equal length, and from each the sharpest frame is taken, one near the
    middle before one of the same sharpness at the edge. Where the camera stood still, time replaces the path.
    """
    way = np.maximum.accumulate(travelled)
    if way[-1] < _STANDS_STILL:
        way = times_s - times_s[0]
    if len(way) <= count or way[-1] <= 0:
        return np.unique(np.linspace(0, len(way) - 1, min(count, len(way))).round().astype(int)).tolist()
    place = way / way[-1] * count
    stretch = np.minimum(place.astype(np.int64), count - 1)
    worth = sharpness * (1 - _OFF_CENTRE * np.abs(2 * (place - stretch) - 1))
    best = np.lexsort((-worth, stretch))
    first = np.ones(len(best), dtype=np.bool_)
    first[1:] = stretch[best][1:] != stretch[best][:-1]
    return sorted(best[first].tolist())


def _laplacian(values: NDArray[np.float32]) -> float:
    inner = values[1:-1, 1:-1]
    around = values[:-2, 1:-1] + values[2:, 1:-1] + values[1:-1, :-2] + values[1:-1, 2:]
    return float(((around - 4 * inner) ** 2).mean()) if inner.size else 0.0


def _halved(values: NDArray[np.float32]) -> NDArray[np.float32]:
    height, width = (side // 2 * 2 for side in values.shape)
    even = values[:height, :width]
    return (even[::2, ::2] + even[1::2, ::2] + even[::2, 1::2] + even[1::2, 1::2]) / np.float32(4)


def _blocks(values: NDArray[np.float32]) -> NDArray[np.float32]:
    """Blocks [m, side, side] side by side, each without its mean; the whole picture where it is smaller than one."""
    side = min(_BLOCK, *values.shape)
    rows, columns = values.shape[0] // side, values.shape[1] // side
    cut = values[: rows * side, : columns * side].reshape(rows, side, columns, side)
    blocks = cut.swapaxes(1, 2).reshape(-1, side, side)
    return blocks - blocks.mean(axis=(1, 2), keepdims=True)


@cache
def _window(side: int) -> NDArray[np.float32]:
    return np.outer(np.hanning(side), np.hanning(side)).astype(np.float32)


def _shift(
    before: NDArray[np.complex64] | None, now: NDArray[np.complex64], telling: NDArray[np.bool_]
) -> float:
    """Median length of the blocks' shifts, px, by phase correlation (Kuglin and Hines 1975); 0 where none is clear."""
    if before is None or not telling.any():
        return 0.0
    product = now[telling] * np.conj(before[telling])
    product /= np.maximum(np.abs(product), 1e-6)
    correlation = np.fft.irfft2(product)
    side = correlation.shape[1]
    peak = correlation.reshape(len(correlation), -1).argmax(axis=1)
    y, x = np.divmod(peak, correlation.shape[2])
    y, x = ((place + side // 2) % side - side // 2 for place in (y, x))
    return float(np.median(np.hypot(y, x)))
