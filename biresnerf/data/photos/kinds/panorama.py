"""Photos that show all directions (equirectangular): told by their metadata, and refused."""

from __future__ import annotations

import re

from PIL import Image

from biresnerf.errors import InputError

HINT = "Cut the panoramas into perspective views (as COLMAP's panorama_sfm does) and give these."
_EQUIRECTANGULAR = re.compile(rb"ProjectionType\W{1,3}equirectangular", re.IGNORECASE)
_XMP = ("xmp", "XML:com.adobe.xmp")  # by JPEG, WebP, TIFF and HEIC; by PNG


def says_equirectangular(image: Image.Image) -> bool:
    """Whether the XMP of an opened image, which is not decoded yet, calls its projection so (Google's GPano)."""
    texts = [image.info.get(key, b"") for key in _XMP]
    return any(
        _EQUIRECTANGULAR.search(text.encode() if isinstance(text, str) else text)
        for text in texts
        if isinstance(text, str | bytes)
    )


def panorama(what: str, where: str) -> InputError:
    """The error for a camera that shows all directions."""
    return InputError(
        "camera_model_unsupported", f"{what}: panoramas are not supported.", where=where, hint=HINT
    )
