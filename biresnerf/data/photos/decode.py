"""Decoding an image file into the pixels its frame means: 8-bit colours, turned and straightened where it says so."""

from __future__ import annotations

from typing import TypeVar

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from biresnerf.data.model.dataset import Frame
from biresnerf.data.photos.image_files import DAMAGED, header_of, is_sixteen_bit, open_image
from biresnerf.data.photos.kinds.linear_light import eight_bit
from biresnerf.data.photos.kinds.sixteen_bit import as_eight_bit
from biresnerf.data.photos.orientation import INVERSE, turned, turned_size
from biresnerf.data.photos.shear import straightened
from biresnerf.errors import InputError
from biresnerf.geometry.camera.camera_models import Camera

T = TypeVar("T", bound=np.generic)
_ALPHA_MODES = frozenset({"RGBA", "LA", "PA", "RGBa", "La"})


def decode(frame: Frame, camera: Camera) -> NDArray[np.uint8]:
    """The frame's pixels, uint8 [h, w, 3] or [h, w, 4] (straight alpha); 16-bit and grey become 8-bit RGB.

    Grey values of 16 bits lie between the set's black and white (`kinds.sixteen_bit`).
    Light as floating-point numbers becomes colours by the rule of `kinds.linear_light`, RAW photos by `kinds.raw_file`.

    Of several pages or frames in one file it is the first. Wide colour spaces are taken as they are.

    Raises:
        InputError: ``not_an_image``, ``image_truncated``, ``image_too_large``, ``image_changed`` or
            ``image_format_unsupported``.
    """
    with open_image(frame.path, frame.name) as image:
        header = header_of(image)
        width, height = turned_size(header.width, header.height, frame.orientation)
        if (width, height) != (camera.width, camera.height):
            raise InputError(
                "image_changed",
                f"has {width} x {height} px now, not {camera.width} x {camera.height}.",
                where=frame.name,
                hint="Leave the images alone while they are being read.",
            )
        try:
            image.load()
            stored = as_stored(_eight_bit(image, frame), image, header.orientation)
            return straightened(turned(stored, frame.orientation), camera.shear)
        except MemoryError:
            raise InputError(
                "image_too_large",
                f"has {header.width} x {header.height} px, for which there is not enough memory.",
                where=frame.name,
                hint="Use a smaller copy of it.",
            ) from None
        except DAMAGED:
            raise InputError(
                "image_truncated",
                "is cut off or damaged.",
                where=frame.name,
                hint="Copy it again, or remove its frame.",
            ) from None


def as_stored(picture: NDArray[T], image: Image.Image, orientation: int) -> NDArray[T]:
    """The decoded ``picture`` as its file has it: Pillow turns a TIFF as its tag says, and nothing else."""
    return turned(picture, INVERSE[orientation]) if image.format == "TIFF" else picture


def _eight_bit(image: Image.Image, frame: Frame) -> NDArray[np.uint8]:
    if is_sixteen_bit(image):
        return np.repeat(as_eight_bit(np.asarray(image), frame.levels)[..., None], 3, axis=2)
    if image.mode == "F":
        return np.repeat(eight_bit(np.asarray(image)[..., None], frame.name), 3, axis=2)
    if image.mode == "I":
        raise InputError(
            "image_format_unsupported",
            "holds 32-bit numbers, which are no colours.",
            where=frame.name,
            hint="Save it with 8 or 16 bits per channel.",
        )
    if image.mode in _ALPHA_MODES or "transparency" in image.info:
        return np.asarray(image.convert("RGBA"))
    return np.asarray(image if image.mode == "RGB" else image.convert("RGB"))  # which would copy it
