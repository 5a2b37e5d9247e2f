"""Decoding every image fully, at working size, into one flat array of bytes."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from biresnerf.data.model.dataset import Dataset
from biresnerf.data.photos.area_resize import area_resize
from biresnerf.data.photos.decode import decode
from biresnerf.data.photos.image_files import quiet_pillow
from biresnerf.data.photos.kinds.photo_kinds import PLAIN_SUFFIXES
from biresnerf.data.photos.masks import is_masked, load_mask, shrink_mask
from biresnerf.geometry.camera.camera_models import Camera
from biresnerf.machine import usable_cores
from biresnerf.options.refine_options import Background

T = TypeVar("T", bound=np.generic)
_WHITE, _BLACK = (1.0, 1.0, 1.0), (0.0, 0.0, 0.0)
# Every core decodes, as far as all full-size pictures held at once fit into this.
_DECODING_BYTES = 2**30
_DECODING_BYTES_PER_PX = 16  # RGBA, and the three copies that Pillow makes on the way to an array
_DEVELOPING_BYTES_PER_PX = 32  # RAW and floating-point numbers take as many
# A set of opaque images shows its scene before plain black or white:
BLACK_BELOW = 24  # of 255: sensors and JPEG leave some light in black
WHITE_ABOVE = 250  # of 255: bright walls and skies stay below it or vary
OPAQUE_ABOVE = 127  # of 255
RIMS = (0.005, 0.995)  # of the pixels that show something before it: specks lie outside
# What photos show before a background has this share of the working size, at least, in photos as many times as large.
CONTENT_SHARE, LARGER_MOST = 0.5, 4.0
BORDER_SHARE = 0.75  # of an image's border pixels that must show the colour; a pedestal may cover one side
IMAGE_SHARE = 0.75  # of the images that must agree; others may show the object cut, or another scene


@dataclass(frozen=True, eq=False)
class ImageSet:
    """All images at working size. Colours are as stored (sRGB values, not linear light), 0 to 255.

    Attributes:
        pixels: uint8 [total_px, 3], image after image, row by row; composited on the background where
            there is transparency.
        alpha: uint8 [total_px], or None where every pixel is opaque.
        offsets: int64 [n + 1]; image i has the pixels from offsets[i] to offsets[i + 1].
        widths, heights: int32 [n], px.
        cameras: of each image, at its working size.
        background: float32 [3], 0 to 1: the colour behind the scene; None where photos show surroundings.
        counts: bool [total_px], which pixels may be learnt from and measured at (masks); None where all may.
    """

    pixels: NDArray[np.uint8]
    alpha: NDArray[np.uint8] | None
    offsets: NDArray[np.int64]
    widths: NDArray[np.int32]
    heights: NDArray[np.int32]
    cameras: tuple[Camera, ...]
    background: NDArray[np.float32] | None
    counts: NDArray[np.bool_] | None = None

    def __len__(self) -> int:
        return len(self.cameras)

    def of(self, images: NDArray[np.int64]) -> ImageSet:
        """The set of images [m] alone, copied."""
        starts, lengths = self.offsets[images], np.diff(self.offsets)[images]
        offsets = np.concatenate(([0], np.cumsum(lengths)))
        pixels = np.arange(offsets[-1]) + np.repeat(starts - offsets[:-1], lengths)
        return replace(
            self,
            pixels=self.pixels[pixels],
            alpha=None if self.alpha is None else self.alpha[pixels],
            offsets=offsets,
            widths=self.widths[images],
            heights=self.heights[images],
            cameras=tuple(self.cameras[i] for i in images),
            counts=None if self.counts is None else self.counts[pixels],
        )

    def image(self, index: int) -> NDArray[np.uint8]:
        """uint8 [h, w, 3], a view of image ``index``."""
        rows = self.pixels[self.offsets[index] : self.offsets[index + 1]]
        return rows.reshape(int(self.heights[index]), int(self.widths[index]), 3)

    def alpha_image(self, index: int) -> NDArray[np.uint8] | None:
        """uint8 [h, w], a view of the opacity of image ``index``, or None where all is opaque."""
        return None if self.alpha is None else self._plane(self.alpha, index)

    def counts_image(self, index: int) -> NDArray[np.bool_] | None:
        """bool [h, w], a view of which pixels of image ``index`` count, or None where there are no masks."""
        return None if self.counts is None else self._plane(self.counts, index)

    def content(self, index: int) -> NDArray[np.bool_] | None:
        """bool [h, w], which pixels of image ``index`` count and show the scene; None where it has surroundings."""
        if self.background is None:
            return None
        opacity, counting = self.alpha_image(index), self.counts_image(index)
        if opacity is not None:
            shown = opacity > OPAQUE_ABOVE
        elif self.background.any():
            shown = self.image(index).min(2) <= WHITE_ABOVE
        else:
            shown = self.image(index).max(2) >= BLACK_BELOW
        return shown if counting is None else shown & counting

    def content_box(self, index: int) -> NDArray[np.float64] | None:
        """Corners [2, 2] (x, y, px) of what image ``index`` shows before the background; None for nothing."""
        content = self.content(index)
        if content is None or not content.any():
            return None
        rows, columns = np.nonzero(content)
        return np.add(np.quantile([columns, rows], RIMS, axis=1), [[0.0], [1.0]])

    def _plane(self, values: NDArray[T], index: int) -> NDArray[T]:
        rows = values[self.offsets[index] : self.offsets[index + 1]]
        return rows.reshape(int(self.heights[index]), int(self.widths[index]))


def working_size(width: int, height: int, max_size: int | None) -> tuple[int, int]:
    """Width and height (px) with the long side at most ``max_size``; never enlarged, never below 1."""
    longest = max(width, height)
    if max_size is None or longest <= max_size:
        return width, height
    return max(1, round(width * max_size / longest)), max(1, round(height * max_size / longest))


def load_images(
    dataset: Dataset,
    max_size: int | None = None,
    background: Background = "auto",
    on_photo: Callable[[int], object] = lambda _done: None,
) -> ImageSet:
    """Decodes all images, shrunk by exact area averaging so that the long side is ``max_size`` px at most.

    ``background``: ``white`` and ``black`` say what lies behind the scene, and what transparency is
    composited on; ``none`` says that photos show surroundings (opacity is then dropped and colours are taken
    as stored); ``auto`` is white where images have transparency, else black or white where all borders show
    it, else none. ``on_photo`` is called with the number of photos decoded so far, after each; it may raise.

    Raises:
        InputError: ``not_an_image``, ``image_truncated``, ``image_too_large``, ``image_changed``,
            ``image_format_unsupported``, ``mask_size_mismatch`` or ``mask_hides_image``, naming the image.
    """
    sizes = [working_size(c.width, c.height, max_size) for c in map(dataset.camera_of, range(len(dataset)))]
    widths = np.array([w for w, _ in sizes], dtype=np.int32)
    heights = np.array([h for _, h in sizes], dtype=np.int32)
    offsets = np.concatenate(([0], np.cumsum(widths.astype(np.int64) * heights)))
    pixels = np.empty((int(offsets[-1]), 3), dtype=np.uint8)
    alpha = np.empty(int(offsets[-1]), dtype=np.uint8)
    masked = is_masked(dataset)
    counts = np.ones(int(offsets[-1]) if masked else 0, dtype=np.bool_)
    behind = _BLACK if background == "black" else _WHITE

    def fill(index: int) -> None:
        part = slice(int(offsets[index]), int(offsets[index + 1]))
        picture = decode(dataset.frames[index], dataset.camera_of(index))
        colour, opacity = _shrink(picture, *sizes[index], behind, keep_alpha=background != "none")
        pixels[part], alpha[part] = colour.reshape(-1, 3), opacity.reshape(-1)
        mask = load_mask(dataset.frames[index], dataset.camera_of(index))
        if mask is not None:
            counts[part] = shrink_mask(mask, *sizes[index]).reshape(-1)

    with quiet_pillow(), ThreadPoolExecutor(decoding_threads(dataset), thread_name_prefix="decode") as pool:
        pending = [pool.submit(fill, index) for index in range(len(dataset))]
        try:
            for done, job in enumerate(pending, 1):
                job.result()
                on_photo(done)
        except BaseException:
            pool.shutdown(wait=True, cancel_futures=True)
            raise
    opaque = bool(alpha.min() == 255)
    cameras = tuple(dataset.camera_of(i).resized(*sizes[i]) for i in range(len(dataset)))
    images = ImageSet(
        pixels, None if opaque else alpha, offsets, widths, heights, cameras, None, counts if masked else None
    )
    return _with_background(images, background, behind)


def load_by_content(
    dataset: Dataset,
    max_size: int,
    background: Background,
    on_photo: Callable[[int], object] = lambda _done: None,
) -> ImageSet:
    """As `load_images`, but with larger photos where an object before a background fills little of them.

    The object is then `CONTENT_SHARE` of ``max_size`` long, as far as photos of `LARGER_MOST` times that size, or the
    files, show it.
    """
    images = load_images(dataset, max_size, background, on_photo)
    boxes = [box for i in range(len(images)) if (box := images.content_box(i)) is not None]
    if not boxes:
        return images
    long_side = float(np.median(np.ptp(boxes, axis=1).max(axis=1)))
    larger = round(max_size * min(LARGER_MOST, CONTENT_SHARE * max_size / long_side))
    if larger <= max_size or max(max(c.width, c.height) for c in dataset.cameras) <= max_size:
        return images
    return load_images(dataset, larger, background, on_photo)


def decoding_threads(dataset: Dataset) -> int:
    """How many photos may be decoded at once: one on each core, as far as memory allows."""
    largest = max(camera.width * camera.height for camera in dataset.cameras)
    plain = all(frame.path.suffix.lower() in PLAIN_SUFFIXES for frame in dataset.frames)
    each = largest * (_DECODING_BYTES_PER_PX if plain else _DEVELOPING_BYTES_PER_PX)
    return max(1, min(usable_cores(), len(dataset), _DECODING_BYTES // each))


def _with_background(images: ImageSet, background: Background, behind: tuple[float, ...]) -> ImageSet:
    colour: NDArray[np.float32] | None
    if background == "none":
        colour = None
    elif background == "auto" and images.alpha is None:
        indices = range(len(images))
        colour = uniform_background(
            [images.image(i) for i in indices], [images.counts_image(i) for i in indices]
        )
    else:
        colour = np.array(behind, dtype=np.float32)
    return replace(images, background=colour)


def uniform_background(
    images: Sequence[NDArray[np.uint8]], counts: Sequence[NDArray[np.bool_] | None]
) -> NDArray[np.float32] | None:
    """Black or white, float32 [3] of 0 or 1, where nearly all borders of ``images`` [h, w, 3] show it.

    Only pixels that count are looked at; images with a wholly masked border are ignored.
    """
    black, white, asked = 0, 0, 0
    for image, counting in zip(images, counts, strict=True):
        border = _border(image)
        if counting is not None:
            border = border[_border(counting)]
        if len(border) == 0:
            continue
        asked += 1
        black += bool((border.max(axis=1) < BLACK_BELOW).mean() >= BORDER_SHARE)
        white += bool((border.min(axis=1) > WHITE_ABOVE).mean() >= BORDER_SHARE)
    if asked == 0:
        return None
    needed = IMAGE_SHARE * asked
    if black >= needed:
        return np.zeros(3, dtype=np.float32)
    if white >= needed:
        return np.ones(3, dtype=np.float32)
    return None


def _border(image: NDArray[T]) -> NDArray[T]:
    return np.concatenate((image[0], image[-1], image[:, 0], image[:, -1]))


def _shrink(
    picture: NDArray[np.uint8], width: int, height: int, behind: tuple[float, ...], *, keep_alpha: bool
) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    """Colour over ``behind`` uint8 [h, w, 3] and opacity uint8 [h, w] at the given size."""
    opaque = np.full((height, width), 255, dtype=np.uint8)
    if picture.shape[2] == 3 or not keep_alpha or picture[..., 3].min() == 255:
        if picture.shape[:2] == (height, width):
            return picture[..., :3], opaque
        return _bytes(area_resize(picture[..., :3], width, height)), opaque
    # Averages of colours weigh by opacity, else hidden colours bleed into the edges.
    small = area_resize(picture, width, height, _premultiplied)
    opacity = small[..., 3:] / 255.0
    colour = small[..., :3] + (1.0 - opacity) * (255.0 * np.asarray(behind, dtype=np.float32))
    return _bytes(colour), _bytes(small[..., 3])


def _premultiplied(rows: NDArray[np.uint8]) -> NDArray[np.float32]:
    weighed = rows.astype(np.float32)
    weighed[..., :3] *= weighed[..., 3:] / 255.0
    return weighed


def _bytes(values: NDArray[np.float32]) -> NDArray[np.uint8]:
    return np.clip(np.rint(values), 0, 255).astype(np.uint8)
