"""Photos that say where they were taken."""

from __future__ import annotations

from fractions import Fraction
from pathlib import Path

from PIL import Image
from PIL.TiffImagePlugin import IFDRational


def geotag(latitude: float, longitude: float, altitude: float) -> Image.Exif:
    """EXIF as cameras write it: degrees, minutes and seconds as fractions, signs as letters."""

    def parts(angle: float) -> tuple[IFDRational, ...]:
        degrees, rest = divmod(abs(angle), 1)
        minutes, rest = divmod(60 * rest, 1)
        return IFDRational(int(degrees)), IFDRational(int(minutes)), _rational(60 * rest)

    exif = Image.Exif()
    exif[0x8825] = {
        **{1: "N" if latitude >= 0 else "S", 2: parts(latitude)},
        **{3: "E" if longitude >= 0 else "W", 4: parts(longitude)},
        **{5: b"\0" if altitude >= 0 else b"\1", 6: _rational(abs(altitude))},
    }
    return exif


def _rational(value: float) -> IFDRational:
    fraction = Fraction(value).limit_denominator(1_000_000)
    return IFDRational(fraction.numerator, fraction.denominator)


def write_geotagged(
    path: Path, place: tuple[float, float, float], picture: Image.Image | None = None
) -> None:
    (picture or Image.new("RGB", (16, 16))).save(path, exif=geotag(*place), quality=95)
