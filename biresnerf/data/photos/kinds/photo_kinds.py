"""The kinds of pictures by the names of their files, and what has to be installed to read them."""

from __future__ import annotations

import importlib.util
from functools import cache
from pathlib import Path
from typing import NamedTuple

from PIL import features

EXTRA = "photos"  # of pyproject.toml
INSTALL = f"pip install 'biresnerf[{EXTRA}]'"
# The order in which a name without extension is tried (NeRF-synthetic is PNG). Pillow reads them in any installation,
# and so do COLMAP and most other programs.
PLAIN_SUFFIXES = (".png", ".jpg", ".jpeg", ".webp", ".tif", ".tiff", ".bmp")


class PhotoKind(NamedTuple):
    """Photos that an extra reads.

    Attributes:
        name: for messages.
        suffixes: of their files, in small letters.
        module: what reads them; None where Pillow itself does.
    """

    name: str
    suffixes: tuple[str, ...]
    module: str | None


HEIC = PhotoKind("HEIC", (".heic", ".heif", ".hif"), "pillow_heif")
PHOTO_KINDS = (
    HEIC,
    PhotoKind("AVIF", (".avif",), None),
    PhotoKind("EXR", (".exr",), "OpenEXR"),
    PhotoKind("HDR", (".hdr",), "imageio_ffmpeg"),
    PhotoKind(
        "RAW",
        (
            *(".dng", ".cr2", ".cr3", ".crw", ".nef", ".nrw", ".arw", ".sr2", ".raf", ".orf", ".rw2", ".rwl"),
            *(".pef", ".srw", ".x3f", ".3fr", ".iiq", ".mrw", ".kdc", ".dcr", ".erf"),
        ),
        "rawpy",
    ),
)
KIND_OF = {suffix: kind for kind in PHOTO_KINDS for suffix in kind.suffixes}
RAW_SUFFIXES = frozenset(next(kind.suffixes for kind in PHOTO_KINDS if kind.name == "RAW"))
# By their first bytes: what a file holds that is called otherwise (phones save HEIC as .jpg).
_HEIC_BRANDS = frozenset({b"heic", b"heix", b"heim", b"heis", b"hevc", b"mif1", b"msf1"})


@cache
def is_readable(kind: PhotoKind) -> bool:
    """Whether what reads this kind is installed."""
    if kind.module is None:
        return bool(features.check("avif"))
    return importlib.util.find_spec(kind.module) is not None


@cache
def image_suffixes() -> tuple[str, ...]:
    """The extensions of all images that can be read here, in small letters; those tried first come first."""
    more = (suffix for kind in PHOTO_KINDS if is_readable(kind) for suffix in kind.suffixes)
    return (*PLAIN_SUFFIXES, *more)


def install_hint(path: Path) -> str:
    """What to install to read a picture that could not be read; empty if nothing is missing."""
    kind = KIND_OF.get(path.suffix.lower()) or _by_content(path)
    if kind is not None and not is_readable(kind):
        return f"Run `{INSTALL}`, which reads {kind.name}."
    if path.suffix.lower() in (".tif", ".tiff") and importlib.util.find_spec("tifffile") is None:
        return f"If it has colours as floating-point numbers, run `{INSTALL}`."
    return ""


def _by_content(path: Path) -> PhotoKind | None:
    try:
        with path.open("rb") as file:
            head = file.read(12)
    except OSError:
        return None
    return HEIC if head[4:8] == b"ftyp" and head[8:12] in _HEIC_BRANDS else None
