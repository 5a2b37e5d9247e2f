"""How often each pixel of a photo is drawn: more often where colours change, as those pixels determine poses.

A ray's weight is its chance at an even draw over the chance it was drawn with, so that weighted means over rays are
those over all pixels, whatever the chances are.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

RUN = 8  # pixels that lie in a row and have the same chance: a number for each would take more memory than the photo


@dataclass(frozen=True)
class PixelChances:
    """Chances of runs of `RUN` pixels of each photo, the last one shorter. Pixels that do not count are left out.

    Attributes:
        begin: int64 [n + 1], where each photo's runs begin in `ends`.
        ends: float64 [runs], a photo's index plus the chance of this run or an earlier one.
        counted: int32, indices of the pixels that count, photo after photo; empty where all do.
        first: int64 [n + 1], where each photo's pixels begin in `counted`.
    """

    begin: Tensor
    ends: Tensor
    counted: Tensor
    first: Tensor

    @staticmethod
    def of(
        halves: list[NDArray[np.uint8]],
        sizes: list[tuple[int, int]],
        counts: list[NDArray[np.bool_] | None],
        share: float,
        device: torch.device,
    ) -> PixelChances:
        """Draws of which a `share` is in proportion to detail, and the rest even.

        Args:
            halves: the photos at half their size [h/2, w/2, 3].
            sizes: w, h.
            counts: which pixels count [h, w], None for a photo that has no mask.
        """
        numbers = [
            w * h if count is None else int(count.sum()) for (w, h), count in zip(sizes, counts, strict=True)
        ]
        first, begin = (np.cumsum([0, *each]) for each in (numbers, [-(-n // RUN) for n in numbers]))
        masked = any(count is not None for count in counts)
        ends, counted = np.empty(begin[-1]), np.empty(first[-1] if masked else 0, np.int32)
        for i, (half, size, count) in enumerate(zip(halves, sizes, counts, strict=True)):
            around = detail(half, *size)
            values = around.reshape(-1) if count is None else around[count]
            runs = np.arange(0, numbers[i], RUN)
            even = np.diff(np.append(runs, numbers[i])) / numbers[i]
            sums = np.add.reduceat(values, runs, dtype=np.float64)
            detailed = sums / sums.sum() if sums.any() else even
            chance = np.cumsum((1 - share) * even + share * detailed)
            ends[begin[i] : begin[i + 1]] = i + chance / chance[-1]
            if masked:
                inside = np.arange(numbers[i]) if count is None else np.flatnonzero(count)
                counted[first[i] : first[i + 1]] = inside
        tensors = (torch.from_numpy(each).to(device) for each in (begin, ends, counted, first))
        return PixelChances(*tensors)

    def arrays(self) -> tuple[int | NDArray[np.generic], ...]:
        """For the kernel on the CPU: `RUN`, and the tensors in their order."""
        return RUN, self.begin.numpy(), self.ends.numpy(), self.counted.numpy(), self.first.numpy()

    def draw(self, image: Tensor, share: Tensor) -> tuple[Tensor, Tensor]:
        """Pixels [rays], by their index in photos `image` [rays], and weights [rays], of random `share` [rays, 2]."""
        run = torch.searchsorted(self.ends, image + share[:, 0].double(), right=True)
        run = torch.minimum(run, self.begin[image + 1] - 1)
        before = torch.where(run > self.begin[image], self.ends[run - 1], image.double())
        number, start = self.first[image + 1] - self.first[image], (run - self.begin[image]) * RUN
        inside = (number - start).clamp(max=RUN)
        place = start + (share[:, 1] * inside).long()
        weight = inside / (number * (self.ends[run] - before))
        return self._pixel(image, place), weight.float()

    def draw_evenly(self, image: Tensor, share: Tensor) -> Tensor:
        """Pixels [rays] of photos `image` [rays], any with the same chance, of random `share` [rays]."""
        number = self.first[image + 1] - self.first[image]
        return self._pixel(image, (share.double() * number).long())

    def _pixel(self, image: Tensor, place: Tensor) -> Tensor:
        return self.counted[self.first[image] + place].long() if len(self.counted) else place


def detail(half: NDArray[np.uint8], width: int, height: int) -> NDArray[np.float32]:
    """How much colours change around each pixel [height, width] of a photo, from the photo at half its size."""
    colours = half.astype(np.float32)
    change: NDArray[np.float32] = np.zeros(colours.shape[:2], np.float32)
    for axis in range(2):
        if colours.shape[axis] > 1:
            change += (np.asarray(np.gradient(colours, axis=axis)) ** 2).sum(2)
    rows = np.minimum(np.arange(height) // 2, len(change) - 1)
    columns = np.minimum(np.arange(width) // 2, change.shape[1] - 1)
    return np.sqrt(change)[rows[:, None], columns]
