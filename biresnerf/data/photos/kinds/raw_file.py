"""Photos as the sensor saw them (DNG, CR2, NEF, ...), developed by LibRaw in the same way for all of a set.

As shot: the camera's white balance, sRGB colours and curve, no brightening by what a photo shows, and white where the
sensor's is. Pixels are as stored, and the camera's orientation is EXIF's, as for JPEG.
"""

from __future__ import annotations

from io import BytesIO
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from biresnerf.data.photos.kinds.picture_file import PictureFile

ORIENTATION, EXIF_IFD, FOCAL_LENGTH, GPS_IFD = 0x0112, 0x8769, 0x920A, 0x8825
_ORIENTATION_OF = {0: 1, 3: 3, 5: 8, 6: 6}  # of LibRaw's ways to turn
# A TIFF but for its number: Olympus and Panasonic. Their tables, as all makers', are near the start.
_TIFF_HEADS = {b"MM\0*": b"MM\0*", **dict.fromkeys((b"II*\0", b"IIRO", b"IIRS", b"IIU\0"), b"II*\0")}
_TABLES = 4 << 20
_SRGB_CURVE = (2.4, 12.92)


class RawFile(PictureFile):
    """A Pillow image of a RAW photo, mode RGB."""

    format = "RAW"
    format_description = "camera RAW"

    def measure(self) -> tuple[int, int, str]:
        import rawpy

        with rawpy.imread(str(self.path)) as raw:
            sizes = raw.sizes
            self._turn = _ORIENTATION_OF.get(sizes.flip, 1)
            self._focal_mm = raw.other.focal_length
            self._preview = _preview(raw)
        return sizes.iwidth, sizes.iheight, "RGB"

    def pixels(self) -> NDArray[np.uint8]:
        import rawpy

        with rawpy.imread(str(self.path)) as raw:
            developed: NDArray[np.uint8] = raw.postprocess(
                use_camera_wb=True,
                no_auto_bright=True,
                adjust_maximum_thr=0.0,  # else white would be the brightest pixel of each photo
                output_color=rawpy.ColorSpace.sRGB,
                gamma=_SRGB_CURVE,
                output_bps=8,
                user_flip=0,
            )
        return developed

    def getexif(self) -> Image.Exif:
        """The EXIF of the RAW file itself, else of its preview."""
        exif = self._own_tables()
        if exif is None or not (exif.get_ifd(EXIF_IFD) or exif.get_ifd(GPS_IFD)):
            exif = self._preview or exif or Image.Exif()
        exif[ORIENTATION] = self._turn
        details = exif.get_ifd(EXIF_IFD)
        if self._focal_mm and FOCAL_LENGTH not in details:
            details[FOCAL_LENGTH] = self._focal_mm
        return exif

    def _own_tables(self) -> Image.Exif | None:
        with self.path.open("rb") as file:
            head = file.read(_TABLES)
        if head[:4] not in _TIFF_HEADS:
            return None
        exif = Image.Exif()
        exif.load_from_fp(BytesIO(_TIFF_HEADS[head[:4]] + head[4:]))
        return exif


def _preview(raw: Any) -> Image.Exif | None:
    """EXIF of the JPEG inside, where files that are not TIFF (CR3, RAF) have it."""
    import rawpy

    try:
        thumb = raw.extract_thumb()
        if thumb.format != rawpy.ThumbFormat.JPEG:
            return None
        with Image.open(BytesIO(thumb.data), formats=("JPEG",)) as image:
            return image.getexif()
    except (rawpy.LibRawError, OSError, SyntaxError):
        return None


Image.register_open(RawFile.format, RawFile)
