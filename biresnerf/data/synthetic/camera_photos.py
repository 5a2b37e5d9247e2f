"""Photos as cameras write them: turned JPEG files with the EXIF of several makers, thumbnails and maker notes."""

from __future__ import annotations

import io
import math
import struct
from dataclasses import dataclass, replace
from datetime import datetime, timedelta
from fractions import Fraction
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import ExifTags, Image
from PIL.TiffImagePlugin import IFDRational

from biresnerf.data.photos.guessed_lens import FILM_DIAGONAL_MM
from biresnerf.data.photos.orientation import INVERSE, shown_from_stored, turned
from biresnerf.geometry.earth.geodesy import place_of

# Latitude, longitude (degrees) and height (m) of the scene's origin.
ORIGIN = np.array([46.5196, 6.6323, 420.0])
_TAKEN = datetime(2024, 5, 1, 10, 0, 0)
_THUMBNAIL = (160, 120)
_QUALITY = 95
_EXIF, _GPS = ExifTags.Base, ExifTags.GPS


@dataclass(frozen=True)
class Maker:
    """What the cameras of one maker write.

    Attributes:
        sensor_mm: the sensor's width, which makes millimetres of focal lengths.
        turns: EXIF orientations of one photo after the other, as the camera is held: 1 level, 6 and 8 on its side.
        note: how its maker notes begin, and how many bytes they have.
        endian: byte order of its EXIF, as `struct` names it.
        film: whether it says the focal length on 35 mm film, in whole millimetres.
        gps_m: standard deviation of the positions that it writes, and that it says; None: it has no GPS.
        gimbal: whether it writes the camera's attitude and the error of its RTK as XMP.
        serial: the body's serial number, if it writes that.
        unit_m: metres in a unit of a scene that it photographs.
    """

    make: str
    model: str
    software: str
    sensor_mm: float
    turns: tuple[int, ...]
    note: tuple[bytes, int]
    endian: str = "<"
    film: bool = True
    lens: str | None = None
    gps_m: float | None = None
    gimbal: bool = False
    serial: str | None = None
    unit_m: float = 0.35


_IPHONE = Maker(
    "Apple", "iPhone 13", "17.4.1", 6.79, (1,), (b"Apple iOS\0\0\1MM\0\x1c", 1400), endian=">",
    lens="iPhone 13 back dual wide camera 5.1mm f/1.6", gps_m=4.7,
)  # fmt: skip
MAKERS = {
    "iphone": _IPHONE,
    "iphone-upright": replace(_IPHONE, turns=(6,)),
    "android": Maker(
        "Google", "Pixel 7", "HDR+ 1.0.540104767zd", 9.82, (1, 8), (b"HDRP\x03", 9000),
        lens="Pixel 7 back camera 6.81mm f/1.85", gps_m=6.0,
    ),
    "reflex": Maker(
        "NIKON CORPORATION", "NIKON D3200", "Ver.1.03 ", 23.2, (1,), (b"Nikon\0\2\x10\0\0MM\0*\0\0\0\x08", 36270),
        endian=">", film=False, lens="18.0-55.0 mm f/3.5-5.6",
    ),
    "drone": Maker(
        "DJI", "M3E", "10.15.01.02", 17.3, (1,), (b"\x10\0\1\0\2\0\4\0\0\0DJI\0", 12000),
        gps_m=0.015, gimbal=True, unit_m=12.0,
    ),
}  # fmt: skip


def write_camera_photo(
    path: Path,
    shown: NDArray[np.uint8],
    maker: Maker,
    number: int,
    focal: float,
    world_from_cam: NDArray[np.float64],
) -> None:
    """Writes what a camera of `maker` would as its photo `number` of a sequence, a second apart.

    Args:
        shown: the upright picture [h, w, 3], or [h, w, 4], which is laid on white. Pixels are stored as the camera's
            sensor has them: `shown` is what viewers make of them by the file's EXIF orientation.
        focal: focal length, px.
        world_from_cam: pose [4, 4] of the upright picture in a world with z up, in the maker's units.
    """
    orientation = turn_of(maker, number)
    if shown.shape[-1] == 4:
        opaque = shown[..., 3:] / 255.0
        shown = np.rint(shown[..., :3] * opaque + 255 * (1 - opaque)).astype(np.uint8)
    photo = Image.fromarray(turned(shown, INVERSE[orientation]))
    east_north_up = maker.unit_m * world_from_cam[:3, 3]
    if maker.gps_m is not None:
        east_north_up = east_north_up + np.random.default_rng([number, 8]).normal(0, maker.gps_m, 3)
    place = place_of(east_north_up, ORIGIN)
    exif = Image.Exif()
    exif.endian = maker.endian
    taken = f"{_TAKEN + timedelta(seconds=number):%Y:%m:%d %H:%M:%S}"
    exif[_EXIF.Make], exif[_EXIF.Model], exif[_EXIF.Software] = maker.make, maker.model, maker.software
    exif[_EXIF.Orientation], exif[_EXIF.DateTime], exif[_EXIF.YCbCrPositioning] = orientation, taken, 1
    exif[_EXIF.XResolution] = exif[_EXIF.YResolution] = IFDRational(72)
    exif[_EXIF.ResolutionUnit] = 2
    exif.get_ifd(ExifTags.IFD.Exif).update(_details(maker, number, taken, photo.size, focal))
    exif.get_ifd(ExifTags.IFD.GPSInfo).update(_gps(maker, place, world_from_cam))
    more = {"xmp": _attitude(place, world_from_cam, maker)} if maker.gimbal else {}
    path.parent.mkdir(parents=True, exist_ok=True)
    photo.save(path, "JPEG", quality=_QUALITY, exif=_with_thumbnail(exif, photo), **more)


def turn_of(maker: Maker | None, number: int) -> int:
    """EXIF's orientation of the maker's photo `number`; 1 without a maker."""
    return 1 if maker is None else maker.turns[number % len(maker.turns)]


def stored_poses(world_from_shown: NDArray[np.float64], maker: Maker | None) -> NDArray[np.float64]:
    """Poses [n, 4, 4] of the pixels as a maker's camera stores them, from those of the upright pictures."""
    turns = [shown_from_stored(turn_of(maker, number)) for number in range(len(world_from_shown))]
    return world_from_shown @ np.stack(turns)


def _details(maker: Maker, number: int, taken: str, size: tuple[int, int], focal: float) -> dict[int, object]:
    """EXIF's own table: exposure, lens, size and maker note."""
    head, length = maker.note
    note = head + np.random.default_rng([number, 9]).bytes(length - len(head))
    focal_mm = focal / max(size) * maker.sensor_mm
    said: dict[int, object] = {}
    if maker.film:
        said[_EXIF.FocalLengthIn35mmFilm] = round(focal / math.hypot(*size) * FILM_DIAGONAL_MM)
    if maker.lens:
        said |= {_EXIF.LensModel: maker.lens, _EXIF.LensMake: maker.make}
    if maker.serial:
        said[_EXIF.BodySerialNumber] = maker.serial
    return {
        _EXIF.ExposureTime: IFDRational(1, 125),
        _EXIF.FNumber: IFDRational(28, 10),
        _EXIF.ISOSpeedRatings: 100,
        _EXIF.ExifVersion: b"0232",
        _EXIF.DateTimeOriginal: taken,
        _EXIF.DateTimeDigitized: taken,
        _EXIF.OffsetTimeOriginal: "+02:00",
        _EXIF.SubsecTimeOriginal: f"{number * 37 % 1000:03}",
        _EXIF.ColorSpace: 1,
        _EXIF.ExifImageWidth: size[0],
        _EXIF.ExifImageHeight: size[1],
        _EXIF.FocalLength: _rational(focal_mm),
        _EXIF.MakerNote: note,
        **said,
    }


def _gps(maker: Maker, place: NDArray[np.float64], world_from_cam: NDArray[np.float64]) -> dict[int, object]:
    """EXIF's table of the position; cameras without a receiver write its version alone."""
    if maker.gps_m is None:
        return {_GPS.GPSVersionID: b"\2\3\0\0"}
    latitude, longitude, height = place.tolist()
    said: dict[int, object] = {
        _GPS.GPSVersionID: b"\2\3\0\0",
        _GPS.GPSLatitudeRef: "N" if latitude >= 0 else "S",
        _GPS.GPSLatitude: _sexagesimal(latitude),
        _GPS.GPSLongitudeRef: "E" if longitude >= 0 else "W",
        _GPS.GPSLongitude: _sexagesimal(longitude),
        _GPS.GPSAltitudeRef: b"\0" if height >= 0 else b"\1",
        _GPS.GPSAltitude: _rational(abs(height)),
    }
    if maker.gimbal:  # a drone says its error in XMP
        return said
    heading = _attitude_deg(world_from_cam)[0] % 360
    return said | {
        _GPS.GPSImgDirectionRef: "T",
        _GPS.GPSImgDirection: _rational(heading),
        _GPS.GPSHPositioningError: _rational(maker.gps_m),
    }


def _attitude_deg(world_from_cam: NDArray[np.float64]) -> tuple[float, float]:
    """Heading from north by east, and how far the camera looks above the horizon."""
    east, north, up = world_from_cam[:3, 2]
    return math.degrees(math.atan2(east, north)), math.degrees(math.asin(np.clip(up, -1, 1)))


def _attitude(place: NDArray[np.float64], world_from_cam: NDArray[np.float64], maker: Maker) -> bytes:
    """An XMP packet as DJI writes it."""
    pitch = _attitude_deg(world_from_cam)[1]
    east, north = world_from_cam[:2, 0]
    yaw = math.degrees(math.atan2(-north, east))  # of a level camera, also where it looks straight down
    said = {
        "AbsoluteAltitude": f"{place[2]:+.3f}",
        "RelativeAltitude": f"{place[2] - ORIGIN[2]:+.3f}",
        "GpsLatitude": f"{place[0]:.9f}",
        "GpsLongitude": f"{place[1]:.9f}",
        "GimbalRollDegree": "+0.00",
        "GimbalYawDegree": f"{yaw:+.2f}",
        "GimbalPitchDegree": f"{pitch:+.2f}",
        "FlightRollDegree": "-1.30",
        "FlightYawDegree": f"{yaw:+.2f}",
        "FlightPitchDegree": "+2.10",
        "RtkFlag": "50",
        **dict.fromkeys(("RtkStdLon", "RtkStdLat", "RtkStdHgt"), f"{maker.gps_m:.5f}"),
    }
    attributes = "\n".join(f'   drone-dji:{name}="{value}"' for name, value in said.items())
    return (
        '<?xpacket begin="\ufeff" id="W5M0MpCehiHzreSzNTczkc9d"?>\n<x:xmpmeta xmlns:x="adobe:ns:meta/">\n'
        ' <rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">\n'
        '  <rdf:Description rdf:about="DJI Meta Data" xmlns:drone-dji="http://www.dji.com/drone-dji/1.0/"\n'
        f'{attributes}/>\n </rdf:RDF>\n</x:xmpmeta>\n<?xpacket end="w"?>'
    ).encode()


def _with_thumbnail(exif: Image.Exif, photo: Image.Image) -> bytes:
    """EXIF with a small JPEG of the photo as its second directory, which Pillow reads and does not write."""
    small, file = photo.copy(), io.BytesIO()
    small.thumbnail(_THUMBNAIL)
    small.save(file, "JPEG", quality=70)
    written = bytearray(exif.tobytes())
    tiff_at, end = len(b"Exif\0\0"), exif.endian
    written += bytes(len(written) % 2)
    entries = struct.unpack_from(f"{end}H", written, tiff_at + 8)[0]
    second = len(written) - tiff_at
    struct.pack_into(f"{end}I", written, tiff_at + 10 + 12 * entries, second)
    rows = (
        (ExifTags.Base.Compression, 3, 6 if end == "<" else 6 << 16),
        (ExifTags.Base.JpegIFOffset, 4, second + 2 + 3 * 12 + 4),
        (ExifTags.Base.JpegIFByteCount, 4, len(file.getvalue())),
    )
    written += struct.pack(f"{end}H", len(rows))
    for tag, kind, value in rows:
        written += struct.pack(f"{end}HHII", tag, kind, 1, value)
    return bytes(written + struct.pack(f"{end}I", 0) + file.getvalue())


def _sexagesimal(angle: float) -> tuple[IFDRational, IFDRational, IFDRational]:
    degrees, rest = divmod(abs(angle), 1)
    minutes, rest = divmod(60 * rest, 1)
    return IFDRational(int(degrees)), IFDRational(int(minutes)), _rational(60 * rest)


def _rational(value: float) -> IFDRational:
    fraction = Fraction(value).limit_denominator(1_000_000)
    return IFDRational(fraction.numerator, fraction.denominator)
