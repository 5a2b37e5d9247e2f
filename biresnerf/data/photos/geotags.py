"""Where photos say that they were taken: the GPS position in EXIF."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from biresnerf.data.photos.image_files import from_exif, open_image, quiet_pillow

_GPS_IFD = 0x8825
_LATITUDE_REF, _LATITUDE, _LONGITUDE_REF, _LONGITUDE, _ALTITUDE_REF, _ALTITUDE = range(1, 7)
_BELOW_SEA = (1, b"\x01")


def read_geotag(path: Path, name: str) -> NDArray[np.float64] | None:
    """Latitude and longitude (degrees, north and east above zero) and altitude (m) [3]; None where one is missing.

    Raises:
        InputError: as `open_image`.
    """
    with quiet_pillow(), open_image(path, name) as image:
        return from_exif(image, _place)


def _place(exif: Image.Exif) -> NDArray[np.float64] | None:
    tags = exif.get_ifd(_GPS_IFD)
    if not {_LATITUDE, _LONGITUDE, _ALTITUDE} <= tags.keys():
        return None
    latitude = _degrees(tags[_LATITUDE]) * (-1 if tags.get(_LATITUDE_REF) == "S" else 1)
    longitude = _degrees(tags[_LONGITUDE]) * (-1 if tags.get(_LONGITUDE_REF) == "W" else 1)
    altitude = float(tags[_ALTITUDE]) * (-1 if tags.get(_ALTITUDE_REF) in _BELOW_SEA else 1)
    place = np.array([latitude, longitude, altitude])
    # Zero for both is what devices write that have no fix yet.
    sensible = np.isfinite(place).all() and (np.abs(place) <= [90, 180, 1e5]).all() and place[:2].any()
    return place if sensible else None


def _degrees(parts: tuple[float, float, float]) -> float:
    degrees, minutes, seconds = (float(part) for part in parts)
    return degrees + minutes / 60 + seconds / 3600
