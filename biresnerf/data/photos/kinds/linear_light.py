"""Pictures that hold light as floating-point numbers (EXR, Radiance HDR, float TIFF), as 8-bit colours.

The rule is the same for every picture, so that exposures stay comparable: 0 is black, 1 is white, what is beyond is cut
off, and between them the curve of sRGB (IEC 61966-2-1) applies. No picture is brightened by what it shows.
"""

from __future__ import annotations

import re
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from biresnerf.data.photos.kinds.picture_file import PictureFile
from biresnerf.errors import InputError

_ROWS = 1 << 22  # numbers turned at once
MOST_WHITE = 0.5  # share of a picture's pixels beyond 1 with which it is not meant by this rule
_HEAD = 4096
# Of float TIFFs: tifffile's axes of pages with and without channels, and Pillow's mode of so many channels.
_AXES = frozenset({"YX", "YXS"})
_MODES = {1: "L", 3: "RGB", 4: "RGBA"}


def eight_bit(light: NDArray[np.floating[Any]], name: str) -> NDArray[np.uint8]:
    """Linear light [h, w, c] as sRGB colours, uint8. Of 2 or 4 channels the last is opacity: colours are premultiplied.

    NaN is black.

    Raises:
        InputError: ``image_format_unsupported``: most pixels are beyond white, so 1 is not white in this file.
    """
    height, width, channels = light.shape
    out = np.empty((height, width, channels), dtype=np.uint8)
    colours = channels - (channels in (2, 4))
    beyond = 0
    step = max(1, _ROWS // (width * channels))
    for first in range(0, height, step):
        part = np.nan_to_num(light[first : first + step].astype(np.float32), nan=0.0, posinf=1e9, neginf=0.0)
        if colours < channels:
            opacity = np.clip(part[..., colours:], 0, 1)
            part[..., :colours] /= np.maximum(opacity, 1e-6)
            out[first : first + step, :, colours:] = np.rint(255 * opacity)
        beyond += int((part[..., :colours].max(axis=2) > 1).sum())
        out[first : first + step, :, :colours] = np.rint(255 * srgb(np.clip(part[..., :colours], 0, 1)))
    if beyond > MOST_WHITE * height * width:
        raise InputError(
            "image_format_unsupported",
            f"{100 * beyond / (height * width):.0f} % of its pixels are brighter than white, which is 1.",
            where=name,
            hint="Divide the values of all photos of the set by one number, so that white is 1.",
        )
    return out


def srgb(linear: NDArray[np.float32]) -> NDArray[np.float32]:
    """The curve of sRGB, from light to stored values, both 0 to 1."""
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * np.power(linear, 1 / 2.4) - 0.055)


class LinearFile(PictureFile):
    """A Pillow image of linear light: `_light` reads it."""

    _light: Callable[[Path], NDArray[Any]]

    def pixels(self) -> NDArray[np.uint8]:
        light = type(self)._light(self.path)
        if light.ndim == 2:
            light = light[..., None]
        shown = eight_bit(light, self.path.name)
        return shown[..., 0] if self.mode == "L" else shown


class ExrFile(LinearFile):
    """OpenEXR: the display window, channels R, G, B and A, or Y."""

    format = "EXR"
    format_description = "OpenEXR"

    def measure(self) -> tuple[int, int, str]:
        import OpenEXR

        header = OpenEXR.File(str(self.path), header_only=True).header()
        names = {channel.name for channel in header["channels"]}
        if not names >= {"R", "G", "B"} and "Y" not in names:
            raise SyntaxError("no channels R, G, B or Y")
        low, high = header["displayWindow"]
        if _area(*header["dataWindow"]) > 4 * _area(low, high):
            raise SyntaxError("far more data than the picture shows")
        coloured = names >= {"R", "G", "B"}
        width, height = (int(value) for value in np.asarray(high) - low + 1)
        return width, height, ("RGBA" if "A" in names else "RGB") if coloured else "L"

    @staticmethod
    def _light(path: Path) -> NDArray[Any]:
        import OpenEXR

        file = OpenEXR.File(str(path))
        channels, header = file.channels(), file.header()
        light = next(channels[name].pixels for name in ("RGBA", "RGB", "Y") if name in channels)
        low, high = (np.asarray(edge) for edge in header["displayWindow"])
        start, end = (np.asarray(edge) for edge in header["dataWindow"])
        if (low == start).all() and (high == end).all():
            return np.asarray(light)
        shown = np.zeros((*(high - low + 1)[::-1], *light.shape[2:]), dtype=light.dtype)
        first, last = np.maximum(low, start), np.minimum(high, end) + 1
        if (first < last).all():
            (x0, y0), (x1, y1) = first - low, last - low
            (u0, v0), (u1, v1) = first - start, last - start
            shown[y0:y1, x0:x1] = light[v0:v1, u0:u1]
        return shown


class FloatTiffFile(LinearFile):
    """TIFF with colours as floating-point numbers, of its first page; Pillow reads only grey ones."""

    format = "FLOAT TIFF"
    format_description = "TIFF of floating-point numbers"

    def measure(self) -> tuple[int, int, str]:
        import tifffile

        with tifffile.TiffFile(self.path) as file:
            page = file.pages.first
            if (
                page.dtype is None
                or page.dtype.kind != "f"
                or page.ndim not in (2, 3)
                or page.axes not in _AXES
            ):
                raise SyntaxError("no floating-point colours")
            count = page.shape[-1] if page.ndim == 3 else 1
            if count not in _MODES:
                raise SyntaxError(f"{count} channels")
            return page.imagewidth, page.imagelength, _MODES[count]

    @staticmethod
    def _light(path: Path) -> NDArray[Any]:
        import tifffile

        with tifffile.TiffFile(path) as file:
            return np.asarray(file.pages.first.asarray())


class RadianceFile(LinearFile):
    """Radiance RGBE (.hdr), in the usual order of rows and columns; FFmpeg decodes it."""

    format = "HDR"
    format_description = "Radiance HDR"

    def measure(self) -> tuple[int, int, str]:
        return (*_radiance_size(self.path), "RGB")

    @staticmethod
    def _light(path: Path) -> NDArray[Any]:
        from imageio_ffmpeg import get_ffmpeg_exe

        width, height = _radiance_size(path)
        command = [
            *(get_ffmpeg_exe(), "-nostdin", "-v", "error", "-threads", "1"),
            *("-protocol_whitelist", "file,pipe"),
            *("-f", "image2", "-pattern_type", "none", "-c:v", "hdr", "-i", f"file:{path.absolute()}"),
            *("-frames:v", "1", "-f", "rawvideo", "-pix_fmt", "gbrpf32le", "-"),
        ]
        made = subprocess.run(command, capture_output=True, check=False)
        if len(made.stdout) != 12 * width * height:
            raise OSError(f"FFmpeg: {made.stderr[-200:].decode(errors='replace')}")
        green, blue, red = np.frombuffer(made.stdout, dtype="<f4").reshape(3, height, width)
        return np.stack([red, green, blue], axis=2)


def _radiance_size(path: Path) -> tuple[int, int]:
    with path.open("rb") as file:
        head = file.read(_HEAD)
    found = re.search(rb"\n\n-Y (\d{1,6}) \+X (\d{1,6})\n", head)
    if found is None or b"FORMAT=32-bit_rle_rgbe" not in head:
        raise SyntaxError("no RGBE of rows from top to bottom")
    return int(found[2]), int(found[1])


def _area(low: NDArray[np.int32], high: NDArray[np.int32]) -> int:
    width, height = (int(b) - int(a) + 1 for a, b in zip(low, high, strict=True))
    return max(0, width) * max(0, height)


Image.register_open(ExrFile.format, ExrFile, lambda head: head.startswith(b"\x76\x2f\x31\x01"))
Image.register_open(
    RadianceFile.format, RadianceFile, lambda head: head.startswith((b"#?RADIANCE", b"#?RGBE"))
)
Image.register_open(
    FloatTiffFile.format,
    FloatTiffFile,
    lambda head: head.startswith((b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")),
)
