"""Finding image files and reading their headers (size, orientation), without decoding them."""

from __future__ import annotations

import struct
import warnings
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

from PIL import Image

from biresnerf.errors import InputError

IMAGE_FORMATS = ("PNG", "JPEG", "WEBP", "TIFF", "BMP")
# The order in which a name without extension is tried (NeRF-synthetic is PNG).
IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".webp", ".tif", ".tiff", ".bmp")
MAX_IMAGE_PIXELS = 150_000_000  # beyond any camera; a guard against files that unpack to gigabytes
EXIF_ORIENTATION = 0x0112

# What Pillow raises on damaged files, gathered from its own fuzz corpus.
DAMAGED: tuple[type[Exception], ...] = (
    *(OSError, SyntaxError, ValueError, EOFError, TypeError, KeyError, IndexError, OverflowError),
    *(AttributeError, MemoryError, struct.error, zlib.error, Image.DecompressionBombError),
)


class ImageHeader(NamedTuple):
    """Stored size (px) and EXIF orientation (1 = as stored)."""

    width: int
    height: int
    orientation: int


@contextmanager
def quiet_pillow() -> Iterator[None]:
    """Silences Pillow's warnings: what cannot be used is refused by an error instead.

    For one thread at a time; enter it before threads are started.
    """
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", module=r"PIL\.")
        yield


def is_image_name(path: Path) -> bool:
    """Whether the extension is one of an image format that can be read."""
    return path.suffix.lower() in IMAGE_SUFFIXES


def find_image(folder: Path, name: str) -> Path | None:
    """The file ``name`` means in ``folder``: as written, with slashes turned, or with an extension."""
    if not name or "\0" in name:
        return None
    spellings = [name] + ([name.replace("\\", "/")] if "\\" in name else [])
    try:
        for spelling in spellings:
            path = folder / spelling
            if path.is_file():
                return path
            for suffix in IMAGE_SUFFIXES:
                for variant in (suffix, suffix.upper()):
                    candidate = path.with_name(path.name + variant) if path.name else path
                    if candidate.is_file():
                        return candidate
    except (OSError, ValueError):  # a name too long for the file system, or one of dots only
        return None
    return None


def open_image(path: Path, name: str) -> Image.Image:
    """The opened, not yet decoded image. Raises InputError ``not_an_image`` or ``image_too_large``."""
    try:
        image = Image.open(path, formats=IMAGE_FORMATS)
    except Image.DecompressionBombError:
        raise _too_large(name) from None
    except DAMAGED as error:
        try:
            empty = path.stat().st_size == 0
        except OSError:
            empty = False
        missing = isinstance(error, PermissionError)
        what = (
            "is an empty file."
            if empty
            else "may not be read."
            if missing
            else "is not an image that can be read."
        )
        raise InputError(
            "not_an_image",
            what,
            where=name,
            mend="Replace it by a PNG, JPEG, WebP, TIFF or BMP file, or remove its frame.",
        ) from None
    if image.width * image.height > MAX_IMAGE_PIXELS:
        image.close()
        raise _too_large(name)
    return image


def read_header(path: Path, name: str) -> ImageHeader:
    """Size and orientation of an image file. Raises InputError as `open_image` does."""
    with quiet_pillow(), open_image(path, name) as image:
        try:
            orientation = image.getexif().get(EXIF_ORIENTATION, 1)
        except DAMAGED:  # broken metadata does not spoil the picture
            orientation = 1
        return ImageHeader(image.width, image.height, orientation if isinstance(orientation, int) else 1)


def _too_large(name: str) -> InputError:
    return InputError(
        "image_too_large",
        f"has more than {MAX_IMAGE_PIXELS // 10**6} million pixels.",
        where=name,
        mend="Scale it down, and its intrinsics with it.",
    )
