"""Random pixels of the photos, with their colour at a chosen sharpness. Photos stay bytes in memory.

Masked pixels are never drawn, nor mixed into blurred colours: each level of the pyramid stores how much of each pixel
counts, and averages are weighted by it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from biresnerf.data.photos.area_resize import area_resize
from biresnerf.data.photos.images import ImageSet
from biresnerf.refinement.kernels.batches import draw_pixels
from biresnerf.refinement.optimise.pixel_chances import PixelChances

PYRAMID_LEVELS = 5
LEVEL_SIGMA = 0.5  # blur of level k, in px: 0.5 * 2**k (a box of 2**k px and the bilinear taps)


# Of rays: image, pixel centre, colour and weight; how many are of training views.
Drawn = tuple[Tensor, Tensor, Tensor, Tensor, int]


@dataclass(frozen=True)
class PixelBatch:
    """`image` [rays] indices, pixel centres `xy` [rays, 2] px, colours [rays, 3] in 0..1: blurred and sharp.

    `weight` [rays] makes sums over rays what they were if all pixels had the same chance. The first `trained` rays
    belong to training views, the rest to held-out ones.
    """

    image: Tensor
    xy: Tensor
    target: Tensor
    sharp: Tensor
    weight: Tensor
    trained: int


class PhotoSampler:
    """Draws the same number of pixels from every image; keeps an image pyramid for coarse-to-fine targets.

    Args:
        by_detail: share of an image's rays that are drawn in proportion to its detail, see `PixelChances`.

    Attributes:
        shares: how much of each of the pyramid's pixels counts, uint8 of 255; None where there are no masks.
    """

    def __init__(
        self, images: ImageSet, held_out: list[int], device: torch.device, by_detail: float = 0.0
    ) -> None:
        count = len(images)
        unseen = set(held_out)
        training = [i for i in range(count) if i not in unseen]
        self.order = torch.tensor(training + sorted(held_out), device=device)
        self.training, self.device = len(training), device
        offsets: list[list[int]] = []
        sizes: list[list[tuple[int, int]]] = []
        base = 0
        pixels = np.empty((_pyramid_pixels(images), 3), dtype=np.uint8)
        current = [images.image(i) for i in range(count)]
        masks, shares = _masks(images), []
        for level in range(PYRAMID_LEVELS):
            if level:
                halves = [_half(image, mask) for image, mask in zip(current, masks, strict=True)]
                current, masks = [image for image, _ in halves], [mask for _, mask in halves]
            if level == 1:
                counts = [images.counts_image(i) for i in range(count)]
                self.chances = PixelChances.of(current, sizes[0], counts, by_detail, device)
            shares += [mask.reshape(-1) for mask in masks if mask is not None]
            begin = base + np.cumsum([0, *(im.shape[0] * im.shape[1] for im in current)])
            offsets.append(begin[:-1].tolist())
            sizes.append([(im.shape[1], im.shape[0]) for im in current])
            for image, first, end in zip(current, begin[:-1], begin[1:], strict=True):
                pixels[first:end] = image.reshape(-1, 3)
            base = int(begin[-1])
        self.pixels = torch.from_numpy(pixels).to(device)
        self.shares = torch.from_numpy(np.concatenate(shares)).to(device) if shares else None
        self.offsets = torch.tensor(offsets, device=device)
        self.sizes = torch.tensor(sizes, device=device)
        self.long_side = float(self.sizes[0].max())
        self._corners = torch.tensor([[[0, 0]], [[0, 1]], [[1, 0]], [[1, 1]]], device=device)
        self._host: torch.Generator | None = None

    def draw(
        self, rays: int, blur_px: float, generator: torch.Generator, *, held_out_only: bool = False
    ) -> PixelBatch:
        """`rays` pixels, spread evenly over all images or the held-out ones, blurred by a random share of `blur_px`."""
        drawn = self._drawn_at_once if self.device.type == "cpu" else self.defined_draw
        image, xy, sharp, weight, trained = drawn(rays, generator, held_out_only)
        sigma = blur_px * self._share(generator)
        target = sharp if sigma <= LEVEL_SIGMA else self._blurred(image, xy, sigma)
        return PixelBatch(image, xy, target, sharp, weight, trained)

    def defined_draw(self, rays: int, generator: torch.Generator, held_out_only: bool) -> Drawn:
        """Image, pixel centre, colour and weight of each ray, and how many are of training views."""
        position, trained = self._positions(rays, generator, held_out_only)
        image = self.order[position]
        share = torch.rand(rays, 2, generator=generator, device=generator.device).to(self.device)
        pixel, weight = self.chances.draw(image, share)
        sharp = self.pixels[self.offsets[0][image] + pixel].float() / 255
        return image, self._centre(image, pixel), sharp, weight, trained

    def _drawn_at_once(self, rays: int, generator: torch.Generator, held_out_only: bool) -> Drawn:
        """The same from the same random numbers in one kernel, on a CPU."""
        where, share = torch.rand(rays, generator=generator), torch.rand(rays, 2, generator=generator)
        image, weight = np.empty(rays, np.int64), np.empty(rays, np.float32)
        xy, sharp = np.empty((rays, 2), np.float32), np.empty((rays, 3), np.float32)
        order, training = (self.order[self.training :], 0) if held_out_only else (self.order, self.training)
        trained = draw_pixels(
            where.numpy(), share.numpy(), order.numpy(), training, self.chances.arrays(), self.sizes[0].numpy(),
            self.offsets[0].numpy(), self.pixels.numpy(), image, xy, sharp, weight,
        )  # fmt: skip
        tensors = [torch.from_numpy(each) for each in (image, xy, sharp, weight)]
        return tensors[0], tensors[1], tensors[2], tensors[3], trained

    def random_pixels(self, image: Tensor, generator: torch.Generator) -> Tensor:
        """The centre [rays, 2] (px) of any pixel that counts, of each of the images `image` [rays]."""
        share = torch.rand(len(image), generator=generator, device=generator.device, dtype=torch.float64)
        return self._centre(image, self.chances.draw_evenly(image, share.to(self.device)))

    def _centre(self, image: Tensor, pixel: Tensor) -> Tensor:
        width = self.sizes[0][image][:, 0]
        return torch.stack([pixel % width, pixel // width], 1) + 0.5

    def counting(self, image: Tensor, xy: Tensor) -> Tensor | None:
        """Whether pixels with centres `xy` [rays, 2] count, 0 or 1 [rays]; None where there are no masks."""
        if self.shares is None:
            return None
        pixel = xy.floor().long()
        index = self.offsets[0][image] + pixel[:, 1] * self.sizes[0][image][:, 0] + pixel[:, 0]
        return (self.shares[index] > 0).float()

    def _positions(self, rays: int, generator: torch.Generator, held_out_only: bool) -> tuple[Tensor, int]:
        """Places in `order`, evenly spread and in turn, and how many are of training views."""
        views = len(self.order)
        if held_out_only:
            return self.training + self._spread(rays, views - self.training, generator), 0
        if generator.device.type == "cpu":
            position = self._spread(rays, views, generator)
            return position, int((position < self.training).sum())
        # On a GPU the host would have to wait for that sum, so it fixes the number, equal to within a ray.
        trained = round(rays * self.training / views)
        parts = (
            turned(self._spread(trained, self.training, generator), self.training, generator),
            self.training + self._spread(rays - trained, views - self.training, generator),
        )
        return torch.cat(parts), trained

    def _spread(self, rays: int, count: int, generator: torch.Generator) -> Tensor:
        """`rays` places in [0, count): one at random in each of as many equal parts."""
        at = generator.device
        where = torch.arange(rays, device=at) + torch.rand(rays, generator=generator, device=at)
        where = where * (count / max(1, rays))
        return where.long().clamp(max=count - 1).to(self.device)

    def _share(self, generator: torch.Generator) -> float:
        """A random number in [0, 1); on a GPU from a generator of the host, which then need not wait."""
        if generator.device.type == "cpu":
            return float(torch.rand((), generator=generator))
        if self._host is None:
            self._host = torch.Generator().manual_seed(generator.initial_seed())
        return float(torch.rand((), generator=self._host))

    def colours(self, image: Tensor, xy: Tensor, sigma: float) -> Tensor:
        """Colours [rays, 3] of pixels with centres `xy` [rays, 2], blurred by `sigma` px."""
        return self._blurred(image, xy, sigma) if sigma > LEVEL_SIGMA else self._bilinear(0, image, xy)

    def _blurred(self, image: Tensor, xy: Tensor, sigma: float) -> Tensor:
        level = min(math.log2(sigma / LEVEL_SIGMA), PYRAMID_LEVELS - 1.0)
        lower = int(level)
        share = level - lower
        colour = self._bilinear(lower, image, xy) * (1 - share)
        if share > 0:
            colour = colour + self._bilinear(lower + 1, image, xy) * share
        return colour

    def _bilinear(self, level: int, image: Tensor, xy: Tensor) -> Tensor:
        size = self.sizes[level, image]
        at = xy * (size / self.sizes[0][image]) - 0.5
        low = at.floor()
        corner = torch.minimum((low + self._corners).long().clamp(min=0), size - 1)  # [4, rays, 2]
        index = self.offsets[level, image] + corner[..., 1] * size[:, 0] + corner[..., 0]
        share = (1 - self._corners - (at - low)).abs().prod(2, keepdim=True)
        if self.shares is None:
            return (share * self.pixels[index]).sum(0) / 255
        share = share * self.shares[index, None]
        return (share * self.pixels[index]).sum(0) / (share.sum(0).clamp(min=1e-6) * 255)


def turned(places: Tensor, count: int, generator: torch.Generator) -> Tensor:
    """Places in [0, count), in order from a random one, so that rays without room are not always the same image's."""
    by = torch.randint(count, (1,), generator=generator, device=generator.device).to(places.device)
    return (places + by) % count


def _pyramid_pixels(images: ImageSet) -> int:
    """The number of pixels of all photos on all levels."""
    widths = (np.maximum(1, images.widths.astype(np.int64) >> k) for k in range(PYRAMID_LEVELS))
    heights = (np.maximum(1, images.heights.astype(np.int64) >> k) for k in range(PYRAMID_LEVELS))
    return int(sum((w * h).sum() for w, h in zip(widths, heights, strict=True)))


def _masks(images: ImageSet) -> list[NDArray[np.uint8] | None]:
    counts = [images.counts_image(i) for i in range(len(images))]
    return [None if c is None else c.astype(np.uint8) * 255 for c in counts]


def _half(
    image: NDArray[np.uint8], share: NDArray[np.uint8] | None
) -> tuple[NDArray[np.uint8], NDArray[np.uint8] | None]:
    """Image and mask at half the size; colours averaged over pixels that count, shares never rounded down to 0."""
    height, width = max(1, image.shape[0] // 2), max(1, image.shape[1] // 2)
    if share is None:
        return _bytes(area_resize(image, width, height)), None
    weighed = np.concatenate([image * (share[..., None] / np.float32(255)), share[..., None]], 2)
    small = area_resize(weighed, width, height)
    return _bytes(small[..., :3] * 255 / np.maximum(small[..., 3:], 1e-6)), _bytes(np.ceil(small[..., 3]))


def _bytes(values: NDArray[np.floating]) -> NDArray[np.uint8]:
    return np.clip(np.rint(values), 0, 255).astype(np.uint8)
