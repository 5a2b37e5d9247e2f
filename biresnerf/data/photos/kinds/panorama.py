"""Photos that show all directions (equirectangular): told by their metadata, and refused."""

from __future__ import annotations

import re

from PIL import Image

from biresnerf.data.photos.kinds.xmp import xmp
from biresnerf.errors import InputError

HINT = "Cut the panoramas into perspective views (as COLMAP's panorama_sfm does) and give these."
_EQUIRECTANGULAR = re.compile(rb"ProjectionType\W{1,3}equirectangular", re.IGNORECASE)


def says_equirectangular(image: Image.Image) -> bool:
    """Whether the XMP of an opened image, which is not decoded yet, calls its projection so (Google's GPano)."""
    return _EQUIRECTANGULAR.search(xmp(image)) is not None


def panorama(what: str, where: str) -> InputError:
    """The error for a camera that shows all directions."""
    return InputError(
        "camera_model_unsupported", f"{what}: panoramas are not supported.", where=where, hint=HINT
    )
