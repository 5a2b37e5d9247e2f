"""Photos that show all directions (equirectangular): detected by their metadata."""

from __future__ import annotations

import re

from PIL import Image

from biresnerf.data.photos.kinds.xmp import xmp
from biresnerf.errors import InputError
from biresnerf.geometry.camera.camera_models import PANORAMA, Camera

_HINT = "Give whole equirectangular panoramas, 360 by 180 degrees, twice as wide as high."
_EQUIRECTANGULAR = re.compile(rb"ProjectionType\W{1,3}equirectangular", re.IGNORECASE)


def says_equirectangular(image: Image.Image) -> bool:
    """Whether the XMP of an opened image, which is not decoded yet, calls its projection so (Google's GPano)."""
    return _EQUIRECTANGULAR.search(xmp(image)) is not None


def panorama_camera(width: int, height: int, where: str) -> Camera:
    """The camera of a panorama of this size (px).

    Raises:
        InputError: ``camera_model_unsupported``: it does not show all directions.
    """
    if width != 2 * height:
        raise InputError(
            "camera_model_unsupported",
            f"{width} x {height} px is no whole panorama: parts of one are not supported.",
            where=where,
            hint=_HINT,
        )
    return Camera(PANORAMA, width, height, ())
