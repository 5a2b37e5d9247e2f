"""Where photos say that they were taken: the GPS position in EXIF, and its accuracy in EXIF or a drone's XMP."""

from __future__ import annotations

import math
from pathlib import Path
from typing import NamedTuple

from PIL import Image

from biresnerf.data.photos.image_files import EXIF_ORIENTATION, from_exif, open_image, quiet_pillow
from biresnerf.data.photos.kinds.xmp import xmp, xmp_number

_GPS_IFD = 0x8825
_LATITUDE_REF, _LATITUDE, _LONGITUDE_REF, _LONGITUDE, _ALTITUDE_REF, _ALTITUDE = range(1, 7)
_ERROR = 0x1F
_BELOW_SEA = (1, b"\x01")
# Standard deviations along east, north and up, m: of DJI's RTK, and as Pix4D's names, which Parrot, MicaSense and
# senseFly use, have them.
_ACCURACY = (
    ("drone-dji:RtkStdLon", "Camera:GPSXYAccuracy"),
    ("drone-dji:RtkStdLat", "Camera:GPSXYAccuracy"),
    ("drone-dji:RtkStdHgt", "Camera:GPSZAccuracy"),
)
_ANGLES = ("drone-dji:GimbalYawDegree", "drone-dji:GimbalPitchDegree", "drone-dji:GimbalRollDegree")
_RTK = "drone-dji:RtkFlag"  # 0: none, 16: of one receiver, 34: float, 50: fixed


class MeasuredPlace(NamedTuple):
    """Where one photo was taken.

    Attributes:
        place: latitude, longitude (degrees, north and east above zero) and height (m); or x, y, z (m).
        accuracy_m: standard deviations along east, north and up, or x, y and z; None where they are not said.
        angles_deg: of the camera, as a drone's gimbal has them: yaw from north over east, pitch above the horizon, and
            roll to the right; None where they are not said.
    """

    place: tuple[float, float, float]
    accuracy_m: tuple[float, float, float] | None = None
    angles_deg: tuple[float, float, float] | None = None


def read_geotag(path: Path, name: str) -> MeasuredPlace | None:
    """Latitude, longitude and altitude by EXIF, with the accuracy that the photo states; None where one is missing.

    Raises:
        InputError: as `open_image`.
    """
    with quiet_pillow(), open_image(path, name) as image:
        place = from_exif(image, _place)
        text, upright = xmp(image), from_exif(image, lambda exif: exif.get(EXIF_ORIENTATION, 1) == 1)
    if place is None:
        return None
    yaw, pitch, roll = (xmp_number(text, name) for name in _ANGLES)
    if upright is not False and yaw is not None and pitch is not None and roll is not None:
        place = place._replace(angles_deg=(yaw, pitch, roll))
    return place._replace(accuracy_m=_of_drone(text) or place.accuracy_m)


def lacks_height(path: Path, name: str) -> bool:
    """Whether a photo's EXIF says latitude and longitude, but no altitude. Raises InputError as `open_image`."""
    with quiet_pillow(), open_image(path, name) as image:
        tags = from_exif(image, lambda exif: set(exif.get_ifd(_GPS_IFD))) or set()
    return {_LATITUDE, _LONGITUDE} <= tags and _ALTITUDE not in tags


def _of_drone(text: bytes) -> tuple[float, float, float] | None:
    """The accuracy that a drone states, unless its RTK was off."""
    east, north, up = (xmp_number(text, *names) for names in _ACCURACY)
    if xmp_number(text, _RTK) == 0 or east is None or north is None or up is None:
        return None
    return (east, north, up) if all(0 < error < 1e6 for error in (east, north, up)) else None


def _place(exif: Image.Exif) -> MeasuredPlace | None:
    tags = exif.get_ifd(_GPS_IFD)
    if not {_LATITUDE, _LONGITUDE, _ALTITUDE} <= tags.keys():
        return None
    latitude = _degrees(tags[_LATITUDE]) * (-1 if tags.get(_LATITUDE_REF) == "S" else 1)
    longitude = _degrees(tags[_LONGITUDE]) * (-1 if tags.get(_LONGITUDE_REF) == "W" else 1)
    altitude = float(tags[_ALTITUDE]) * (-1 if tags.get(_ALTITUDE_REF) in _BELOW_SEA else 1)
    # Devices without a fix write zero for both. Comparisons with NaN are false.
    sensible = (
        abs(latitude) <= 90 and abs(longitude) <= 180 and abs(altitude) <= 1e5 and (latitude or longitude)
    )
    if not sensible:
        return None
    error = float(tags.get(_ERROR, math.nan))
    return MeasuredPlace((latitude, longitude, altitude), (error,) * 3 if 0 < error < 1e6 else None)


def _degrees(parts: tuple[float, float, float]) -> float:
    degrees, minutes, seconds = (float(part) for part in parts)
    return degrees + minutes / 60 + seconds / 3600
