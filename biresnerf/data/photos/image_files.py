"""Finding image files and reading their headers (size, orientation), without decoding them."""

from __future__ import annotations

import math
import struct
import warnings
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache, lru_cache
from pathlib import Path
from typing import NamedTuple, TypeVar

from PIL import Image
from PIL.JpegImagePlugin import MARKER
from PIL.TiffImagePlugin import TiffImageFile

from biresnerf.data.photos.kinds import linear_light, raw_file
from biresnerf.data.photos.kinds.photo_kinds import (
    HEIC,
    PLAIN_SUFFIXES,
    RAW_SUFFIXES,
    image_suffixes,
    install_hint,
    is_readable,
)
from biresnerf.data.photos.kinds.xmp import xmp, xmp_number, xmp_text
from biresnerf.data.photos.panoramas.panorama import says_equirectangular
from biresnerf.errors import InputError

# What COLMAP and other programs read, too; the others are decoded for them.
PLAIN_FORMATS = ("PNG", "JPEG", "WEBP", "TIFF", "BMP")
_MORE_FORMATS = (
    "AVIF", linear_light.ExrFile.format, linear_light.RadianceFile.format, linear_light.FloatTiffFile.format,
)  # fmt: skip
_JPEG = (".jpg", ".jpeg")
MAX_IMAGE_PIXELS = 150_000_000  # beyond any camera; a guard against files that unpack to gigabytes
# Of a JPEG, before its pixels. Depth maps and thermal images in one are in hundreds, EXIF in one.
MAX_PIECES, MAX_EXIF_SEGMENTS = 65_536, 64
_APP1, _START_OF_SCAN = 0xFFE1, 0xFFDA
EXIF_ORIENTATION = 0x0112
_TIFF_WIDTH, _TIFF_HEIGHT = 0x0100, 0x0101
_EXIF_SUB_IFD = 0x8769
_FOCAL_LENGTH, _FOCAL_LENGTH_35MM = 0x920A, 0xA405
_MAKE, _MODEL = 0x010F, 0x0110
_LENS_MODEL, _BODY_SERIAL, _LENS_SERIAL = 0xA434, 0xA431, 0xA435
_PIXEL_X, _PIXEL_Y = 0xA002, 0xA003
_FOCAL_PLANE_X, _FOCAL_PLANE_Y, _FOCAL_PLANE_UNIT = 0xA20E, 0xA20F, 0xA210
_UNIT_MM = {2: 25.4, 3: 10.0, 4: 1.0, 5: 1e-3}  # inch, cm, mm, um

# What Pillow raises on damaged files, gathered from its own fuzz corpus.
DAMAGED: tuple[type[Exception], ...] = (
    *(OSError, SyntaxError, ValueError, EOFError, TypeError, KeyError, IndexError, OverflowError),
    *(AttributeError, MemoryError, RuntimeError, struct.error, zlib.error, Image.DecompressionBombError),
)
UNREADABLE: tuple[type[Exception], ...] = (InputError, *DAMAGED)

T = TypeVar("T")


class FocalPlane(NamedTuple):
    """EXIF's focal plane resolution: px per mm of the sensor, of a picture of `width` x `height` px (0: unknown)."""

    px_per_mm_x: float
    px_per_mm_y: float
    width: int
    height: int


class MakerLens(NamedTuple):
    """A drone's lens as its maker measured it, in OpenCV's model; px of a picture of `width` px (0: of this one).

    Attributes:
        cx, cy: of the principal point, from the middle of the picture.
    """

    width: float
    fx: float
    fy: float
    cx: float
    cy: float
    k1: float
    k2: float
    p1: float
    p2: float
    k3: float


class ImageHeader(NamedTuple):
    """The header of a stored picture; EXIF values are unchecked but positive.

    Attributes:
        width, height: stored size, px.
        orientation: EXIF's, 1 to 8; 1 = show as stored, 5 to 8 exchange width and height.
        focal_mm: focal length.
        focal_35mm: the focal length, mm, that sees as much on 35 mm film (36 x 24 mm).
        focal_plane: the sensor's resolution, which makes pixels of `focal_mm`.
        several: the file holds more pages or frames than the first one.
        sixteen_bit: its values are grey ones of 16 bits.
        taken_with: make, model and serial number of the camera, model and serial number of its lens, and the focal
            length (mm): photos that differ in them have lenses that differ.
        equirectangular: its XMP calls it a panorama of this projection.
        maker_lens: its XMP's, of the picture as stored.
    """

    width: int
    height: int
    orientation: int = 1
    focal_mm: float | None = None
    focal_35mm: float | None = None
    focal_plane: FocalPlane | None = None
    several: bool = False
    equirectangular: bool = False
    sixteen_bit: bool = False
    taken_with: tuple[str, ...] = ()
    maker_lens: MakerLens | None = None


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
    return path.suffix.lower() in image_suffixes()


def images_called(folder: Path, name: str) -> list[Path]:
    """The files that ``name`` may mean in ``folder``: as written, with slashes turned, or with an extension.

    Of a JPEG and a PNG of one name, the PNG may be a mask or a depth: those in colour go first, then JPEG.
    """
    if not name or "\0" in name:
        return []
    spellings = [name] + ([name.replace("\\", "/")] if "\\" in name else [])
    try:
        for spelling in spellings:
            path = folder / spelling
            if path.is_file():
                return [path]
            found: dict[str, Path] = {}  # file systems may not distinguish letter cases
            for suffix in image_suffixes():
                if found and suffix not in PLAIN_SUFFIXES:
                    break
                for variant in (suffix, suffix.upper()):
                    candidate = path.with_name(path.name + variant) if path.name else path
                    if candidate.is_file():
                        found.setdefault(suffix, candidate)
            if len(found) > 1:
                return sorted(
                    found.values(), key=lambda one: (greyness(one), one.suffix.lower() not in _JPEG)
                )
            if found:
                return list(found.values())
    except (OSError, ValueError):  # a name too long for the file system, or one of dots only
        return []
    return []


def greyness(path: Path) -> int:
    """2 for a picture of one channel, as masks and depth maps are, 1 for one that shows no colours, else 0.

    It may be decoded, once.
    """
    try:
        stat = path.stat()
    except OSError:
        return 0
    return _greyness(path, stat.st_mtime_ns, stat.st_size)


@lru_cache(maxsize=4096)
def _greyness(path: Path, _mtime_ns: int, _size: int) -> int:
    try:
        with quiet_pillow(), open_image(path, path.name) as image:
            if image.mode in ("1", "L", "LA", "F") or image.mode.startswith("I"):
                return 2
            red, green, blue = image.convert("RGB").split()
            return int(red.tobytes() == green.tobytes() == blue.tobytes())
    except UNREADABLE:
        return 0


def open_image(path: Path, name: str) -> Image.Image:
    """The opened, not yet decoded image. Raises InputError ``not_an_image`` or ``image_too_large``.

    Its content says of which format it is. Only RAW photos are known by their names: most are TIFF files otherwise, of
    which Pillow would take the preview.
    """
    _refuse_segments(path, name)
    try:
        image = Image.open(path, formats=_formats_for(path))
    except Image.DecompressionBombError:
        raise _too_large(name) from None
    except DAMAGED as error:
        what = "is not an image that can be read."
        if isinstance(error, PermissionError):
            what = "may not be read."
        elif path.is_file() and path.stat().st_size == 0:
            what = "is an empty file."
        raise InputError(
            "not_an_image",
            what,
            where=name,
            hint=install_hint(path)
            or "Replace it by a PNG, JPEG, WebP, TIFF or BMP file, or remove its frame.",
        ) from None
    if image.format == "TIFF":
        # Without a file name it is not mapped into memory: Pillow maps a turned TIFF with its sides exchanged.
        image.filename = ""
    if image.width * image.height > MAX_IMAGE_PIXELS:
        image.close()
        raise _too_large(name)
    return image


def _refuse_segments(path: Path, name: str) -> None:
    """Raises InputError ``not_an_image`` for a JPEG whose head is in more pieces than any camera or program writes.

    Pillow takes time by their number, and by its square where they are EXIF. This scans the file as Pillow does.
    """
    pieces = exif = 0
    try:
        with path.open("rb") as file:
            start = file.read(3)
            mark = start[2:] if start == b"\xff\xd8\xff" else b""  # as Pillow knows a JPEG
            while mark and pieces <= MAX_PIECES and exif <= MAX_EXIF_SEGMENTS:
                pieces += 1
                if mark != b"\xff":  # junk
                    mark = file.read(1)
                    continue
                kind = int.from_bytes(b"\xff" + file.read(1), "big")
                if kind == _START_OF_SCAN or (kind not in MARKER and kind not in (0xFF00, 0xFFFF)):
                    return
                if kind in MARKER and MARKER[kind][2] is not None:
                    length = int.from_bytes(file.read(2), "big") - 2
                    begin = file.read(min(max(length, 0), 4))
                    exif += kind == _APP1 and begin == b"Exif"
                    file.seek(max(length - len(begin), 0), 1)
                mark = b"\xff" if kind == 0xFFFF else file.read(1)
            if not mark:
                return
    except OSError:  # Pillow finds the same
        return
    raise InputError(
        "not_an_image",
        f"has a head of more than {MAX_PIECES} pieces, or {MAX_EXIF_SEGMENTS} of EXIF.",
        where=name,
        hint="Save it again without metadata, or remove its frame.",
    )


def _formats_for(path: Path) -> tuple[str, ...]:
    return (raw_file.RawFile.format,) if path.suffix.lower() in RAW_SUFFIXES else _all_but_raw()


@cache
def _all_but_raw() -> tuple[str, ...]:
    if not is_readable(HEIC):
        return PLAIN_FORMATS + _MORE_FORMATS
    import pillow_heif

    pillow_heif.options.DECODE_THREADS = 1  # photos are decoded side by side already
    pillow_heif.register_heif_opener()
    return (*PLAIN_FORMATS, "HEIF", *_MORE_FORMATS)


def is_plain(path: Path, name: str) -> bool:
    """Whether an image has a format and a pixel type that other programs read, too. Raises as `open_image`."""
    with quiet_pillow(), open_image(path, name) as image:
        return image.format in (*PLAIN_FORMATS, "MPO") and image.mode != "F"


def read_header(path: Path, name: str) -> ImageHeader:
    """Size, EXIF orientation and focal length of an image file. Raises InputError as `open_image` does."""
    with quiet_pillow(), open_image(path, name) as image:
        return header_of(image)


def header_of(image: Image.Image) -> ImageHeader:
    """Size, EXIF orientation and focal length of an opened image that is not decoded yet."""
    header = ImageHeader(
        *stored_size(image),
        several=_holds_several(image),
        equirectangular=says_equirectangular(image),
        sixteen_bit=is_sixteen_bit(image),
        maker_lens=_maker_lens(xmp(image)),
    )
    return from_exif(image, lambda exif: _with_exif(header, exif)) or header


def _maker_lens(text: bytes) -> MakerLens | None:
    """DJI's ``DewarpData`` (manuals of Mavic 3M and Matrice 4), if the picture still has this distortion.

    It is "date;fx,fy,cx,cy,k1,k2,p1,p2,k3".
    """
    said = xmp_text(text, "drone-dji:DewarpData")
    if said is None or xmp_number(text, "drone-dji:DewarpFlag") == 1:
        return None
    try:
        numbers = [float(number) for number in said.rpartition(";")[2].split(",")]
    except ValueError:
        return None
    if len(numbers) != len(MakerLens._fields) - 1 or not all(map(math.isfinite, numbers)):
        return None
    return MakerLens(2 * (xmp_number(text, "drone-dji:CalibratedOpticalCenterX") or 0.0), *numbers)


def from_exif(image: Image.Image, read: Callable[[Image.Exif], T]) -> T | None:
    """What ``read`` finds in the EXIF data of an opened image; None where these are damaged, or it has none."""
    # Pillow would decode a whole PNG in search of EXIF behind its pixels.
    if image.format == "PNG" and "exif" not in image.info:
        return None
    try:
        return read(image.getexif())
    except DAMAGED:  # broken metadata does not spoil the picture
        return None


def stored_size(image: Image.Image) -> tuple[int, int]:
    """Width and height (px) of the pixels as stored; Pillow gives those of a turned TIFF as shown."""
    if isinstance(image, TiffImageFile):
        return int(image.tag_v2[_TIFF_WIDTH]), int(image.tag_v2[_TIFF_HEIGHT])
    return image.size


def is_sixteen_bit(image: Image.Image) -> bool:
    """Whether an opened image is a grey one of 16 bits."""
    return image.mode.startswith("I;16") or (image.mode == "I" and image.format == "PNG")


def _holds_several(image: Image.Image) -> bool:
    # Phones put previews and depth maps behind a JPEG; they are no pages of it.
    return image.format in ("TIFF", "WEBP", "PNG", "AVIF") and bool(getattr(image, "is_animated", False))


def _with_exif(header: ImageHeader, exif: Image.Exif) -> ImageHeader:
    details = exif.get_ifd(_EXIF_SUB_IFD)
    orientation = exif.get(EXIF_ORIENTATION, 1)
    unit = _UNIT_MM.get(details.get(_FOCAL_PLANE_UNIT, 2))
    x, y = _positive(details.get(_FOCAL_PLANE_X)), _positive(details.get(_FOCAL_PLANE_Y))
    plane = None
    if unit and (x or y):
        width, height = (_positive(details.get(key)) or 0 for key in (_PIXEL_X, _PIXEL_Y))
        plane = FocalPlane((x or y or 0) / unit, (y or x or 0) / unit, int(width), int(height))
    said = [exif.get(_MAKE), exif.get(_MODEL), details.get(_BODY_SERIAL)]
    said += [details.get(_LENS_MODEL), details.get(_LENS_SERIAL), _positive(details.get(_FOCAL_LENGTH))]
    return header._replace(
        taken_with=tuple("" if one is None else str(one).strip("\0 ") for one in said) if any(said) else (),
        orientation=orientation if orientation in range(1, 9) else 1,
        focal_mm=_positive(details.get(_FOCAL_LENGTH)),
        focal_35mm=_positive(details.get(_FOCAL_LENGTH_35MM)),
        focal_plane=plane,
    )


def _positive(value: object) -> float | None:
    """A finite number above zero, or None: cameras write 0, 0/0 and worse for what they do not know."""
    try:
        number = float(value)  # type: ignore[arg-type]
    except (TypeError, ValueError, ZeroDivisionError, OverflowError):
        return None
    return number if 0 < number < 1e9 else None


def _too_large(name: str) -> InputError:
    return InputError(
        "image_too_large",
        f"has more than {MAX_IMAGE_PIXELS // 10**6} million pixels.",
        where=name,
        hint="Scale it down, and its intrinsics with it.",
    )
