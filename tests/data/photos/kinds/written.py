"""Photos of kinds that Pillow does not write: DNG with the tags of a camera, EXR, float TIFF, HDR."""

from __future__ import annotations

import struct
import subprocess
from pathlib import Path

import numpy as np
import OpenEXR
import tifffile
from imageio_ffmpeg import get_ffmpeg_exe
from PIL.TiffImagePlugin import IFDRational, ImageFileDirectory_v2

WHITE = 4095  # of a sensor of 12 bits


def linear(srgb: np.ndarray) -> np.ndarray:
    """The light of stored values (IEC 61966-2-1, inverse), both 0 to 1."""
    return np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)


def write_exr(path: Path, light: np.ndarray, half: bool = False, **header: object) -> None:
    name = {2: "Y", 3: "RGB", 4: "RGBA"}[light.ndim if light.ndim == 2 else light.shape[2]]
    values = np.ascontiguousarray(light.astype(np.float16 if half else np.float32))
    kind = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage, **header}
    OpenEXR.File(kind, {name: values}).write(str(path))


def write_float_tiff(path: Path, light: np.ndarray) -> None:
    kind = "rgb" if light.ndim == 3 else "minisblack"
    tifffile.imwrite(path, light.astype(np.float32), photometric=kind, compression="zlib")


def write_hdr(path: Path, light: np.ndarray) -> None:
    """By FFmpeg."""
    height, width = light.shape[:2]
    planes = np.ascontiguousarray(light.astype("<f4")[..., [1, 2, 0]].transpose(2, 0, 1)).tobytes()
    form = ("-f", "rawvideo", "-pix_fmt", "gbrpf32le", "-s", f"{width}x{height}")
    subprocess.run(
        [get_ffmpeg_exe(), "-y", "-v", "error", *form, "-i", "-", str(path)], input=planes, check=True
    )


def write_dng(
    path: Path, light: np.ndarray, tables: dict[int, dict] | None = None, orientation: int = 1
) -> None:
    """A DNG 1.4 of 12 bits, uncompressed, with the mosaic RGGB of linear light [h, w, 3] in sRGB's colours.

    Its matrix is XYZ (D65) to linear sRGB, so that developing gives the light back. ``tables``: EXIF's, by their tag.
    """
    height, width = light.shape[:2]
    mosaic = np.empty((height, width), dtype="<u2")
    values = np.rint(np.clip(light, 0, 1) * WHITE)
    for y, x, channel in ((0, 0, 0), (0, 1, 1), (1, 0, 1), (1, 1, 2)):
        mosaic[y::2, x::2] = values[y::2, x::2, channel]
    srgb_from_xyz = (3.2406, -1.5372, -0.4986, -0.9689, 1.8758, 0.0415, 0.0557, -0.2040, 1.0570)
    tags = ImageFileDirectory_v2(b"II*\0\0\0\0\0")
    kinds = {
        254: 4,
        256: 4,
        257: 4,
        258: 3,
        259: 3,
        262: 3,
        271: 2,
        272: 2,
        273: 4,
        274: 3,
        277: 3,
        278: 4,
        279: 4,
    }
    kinds |= {33421: 3, 33422: 1, 50706: 1, 50708: 2, 50714: 3, 50717: 3, 50721: 10, 50728: 5, 50778: 3}
    tags.tagtype.update(kinds)
    tags[254], tags[256], tags[257], tags[258], tags[259], tags[262] = 0, width, height, 16, 1, 32803
    tags[271], tags[272], tags[274], tags[277], tags[278] = "Test", "Test 1", orientation, 1, height
    tags[279], tags[33421], tags[33422] = 2 * mosaic.size, (2, 2), bytes((0, 1, 1, 2))
    tags[50706], tags[50708], tags[50714], tags[50717] = bytes((1, 4, 0, 0)), "Test 1", 0, WHITE
    tags[50721] = tuple(IFDRational(round(1e4 * value), 10_000) for value in srgb_from_xyz)
    tags[50728] = (IFDRational(1, 1),) * 3
    tags[50778] = 21  # D65
    for table, values in (tables or {}).items():
        tags[table] = values
    tags[273] = 0  # Pillow counts it from the end of the tables
    path.write_bytes(struct.pack("<2sHI", b"II", 42, 8) + tags.tobytes(8) + mosaic.tobytes())
