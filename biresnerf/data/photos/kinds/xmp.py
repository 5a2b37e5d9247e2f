"""XMP, the metadata in XML that cameras, drones and panorama makers add to photos."""

from __future__ import annotations

import re

from PIL import Image

_KEYS = ("xmp", "XML:com.adobe.xmp")  # of JPEG, WebP, TIFF and HEIC; of PNG


def xmp(image: Image.Image) -> bytes:
    """The XMP of an opened image, which is not decoded yet; empty where there is none."""
    texts = (image.info.get(key, b"") for key in _KEYS)
    return b"".join(t.encode() if isinstance(t, str) else t for t in texts if isinstance(t, str | bytes))


def xmp_text(text: bytes, name: str) -> str | None:
    """A property (``prefix:Name``), as an attribute or an element."""
    found = re.search(rb"\b%s(?:\s*=\s*[\"']|>)\s*([^\"'<]+)" % name.encode(), text)
    return found[1].decode("utf-8", "replace").strip() if found else None


def xmp_number(text: bytes, *names: str) -> float | None:
    """The first of these properties (``prefix:Name``) that is a number, as an attribute or an element."""
    for name in names:
        found = re.search(rb"\b%s(?:\s*=\s*[\"']|>)\s*([-+.\deE]+)" % name.encode(), text)
        try:
            if found:
                return float(found[1])
        except ValueError:
            continue
    return None
