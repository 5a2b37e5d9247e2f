"""Tables of where photos were taken: csv with a header, Metashape's reference file, OpenDroneMap's geo.txt."""

from __future__ import annotations

import csv
import math
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from biresnerf.data.model.untrusted_file import read_text
from biresnerf.data.photos.geotags import MeasuredPlace
from biresnerf.errors import InputError

# Looked for in the folder of the photos, in this order, whatever their case.
POSITION_FILES = ("positions.csv", "gps.csv", "geotags.csv", "reference.csv", "reference.txt", "geo.txt")
WGS84 = 4979  # EPSG's number of latitude, longitude and ellipsoidal height
EPSG = r'AUTHORITY\["EPSG",\s*"(\d+)"\]'  # in the text form of a frame, the last one is its own
_DEGREES = frozenset({4326, WGS84})
_HINT = "Write a header line: name,lat,lon,alt[,accuracy] in degrees and metres, or name,x,y,z[,accuracy] in metres."
_COLUMNS = {
    "name": ("name", "label", "image", "imagename", "filename", "file", "photo"),
    "lat": ("lat", "latitude"),
    "lon": ("lon", "lng", "long", "longitude"),
    "x": ("x", "easting", "xeasting", "xlongitude"),
    "y": ("y", "northing", "ynorthing", "ylatitude"),
    "z": ("z", "alt", "altitude", "height", "elevation", "zaltitude", "zheight"),
    "accuracy": ("accuracy", "accuracym", "sigma", "std", "xyzaccuracy"),
}
_ODM_ACCURACY = 7  # column of geo.txt's horizontal accuracy, after name, position and angles


@dataclass(frozen=True)
class PositionTable:
    """What a source says of places.

    Attributes:
        source: for messages: the file's name.
        places: by the photos' names as the source writes them.
        in_degrees: places are latitude, longitude and height.
        epsg: the frame's number, where it is known.
    """

    source: str
    places: dict[str, MeasuredPlace]
    in_degrees: bool
    epsg: int | None


def position_file(root: Path) -> Path | None:
    """The table of positions in the folder ``root``, if it has one."""
    files = {path.name.lower(): path for path in sorted(root.iterdir()) if path.is_file()}
    return next((files[name] for name in POSITION_FILES if name in files), None)


def read_position_table(file: Path) -> PositionTable:
    """The places in a file.

    Raises:
        InputError: ``positions_invalid``, with the line.
    """
    lines = read_text(file).splitlines()
    if lines and (found := re.fullmatch(r"\s*EPSG:(\d{4,6})\s*", lines[0], re.I)):
        return _geo_txt(file.name, lines, int(found[1]))
    said = next((line for line in lines if "coordinatesystem" in line.lower().replace(" ", "")), "")
    header, rows = _header_and_rows(file.name, lines)
    degrees = "lat" in header or ("xlongitude" in _plain(lines) and not re.search("LOCAL|PROJCS", said, re.I))
    order = ("lat", "lon", "z") if "lat" in header else ("y", "x", "z") if degrees else ("x", "y", "z")
    missing = [name for name in ("name", *order) if name not in header]
    if missing:
        raise _invalid(f"{file.name}", f"has no column for {', '.join(missing)}.")
    numbers = re.findall(EPSG, said)
    places: dict[str, MeasuredPlace] = {}
    for number, cells in rows:
        where = f"{file.name} line {number}"
        texts = [_cell(cells, header[name]) for name in order]
        name = _cell(cells, header["name"])
        if not name or not any(texts):  # Metashape lists photos without a reference, too
            continue
        accuracy = _cell(cells, header["accuracy"]) if "accuracy" in header else ""
        _add(places, name, texts, accuracy, where, degrees=degrees)
    epsg = WGS84 if degrees else int(numbers[-1]) if numbers else None
    return PositionTable(file.name, places, degrees, epsg)


def _geo_txt(source: str, lines: Sequence[str], epsg: int) -> PositionTable:
    """Name, x (or longitude), y (or latitude), height, and perhaps angles and accuracies, between spaces."""
    degrees, places = epsg in _DEGREES, dict[str, MeasuredPlace]()
    for number, line in enumerate(lines[1:], 2):
        cells = line.split()
        if not cells or cells[0].startswith("#"):
            continue
        where = f"{source} line {number}"
        if len(cells) < 4:
            raise _invalid(where, "has less than a name and three numbers.")
        x, y, z = cells[1:4]
        texts = [y, x, z] if degrees else [x, y, z]
        _add(places, cells[0], texts, _cell(cells, _ODM_ACCURACY), where, degrees=degrees)
    return PositionTable(source, places, degrees, WGS84 if degrees else epsg)


def _header_and_rows(
    source: str, lines: Sequence[str]
) -> tuple[dict[str, int], Iterator[tuple[int, list[str]]]]:
    for index, line in enumerate(lines):
        separator = max(",;\t", key=line.count)
        titles = [_plain([cell]) for cell in line.split(separator)]
        header = {
            meaning: titles.index(title)
            for meaning, names in _COLUMNS.items()
            for title in reversed(names)
            if title in titles
        }
        if "name" in header and len(header) > 3:
            below = list(enumerate(lines[index + 1 :], index + 2))
            told = [(number, line) for number, line in below if line.strip() and not line.startswith("#")]
            cells = csv.reader((line for _, line in told), delimiter=separator)
            return header, ((n, row) for (n, _), row in zip(told, cells, strict=False))
    raise _invalid(source, "has no header that names a name and three coordinates.")


def _plain(texts: Sequence[str]) -> str:
    """Letters alone, small: ``#Label`` and ``X/Longitude`` as label and xlongitude."""
    return re.sub(r"[^a-z\n]", "", "\n".join(texts).lower())


def _cell(cells: Sequence[str], column: int) -> str:
    return cells[column].strip() if column < len(cells) else ""


def _add(
    places: dict[str, MeasuredPlace],
    name: str,
    texts: Sequence[str],
    accuracy: str,
    where: str,
    *,
    degrees: bool,
) -> None:
    try:
        a, b, c = (float(text) for text in texts)
        deviation = float(accuracy) if accuracy else None
    except ValueError:
        raise _invalid(where, f"has {', '.join(texts)}, which are not three numbers.") from None
    if not all(math.isfinite(value) and abs(value) < 1e9 for value in (a, b, c)):
        raise _invalid(where, "has numbers that are no position.")
    if degrees and not (abs(a) <= 90 and abs(b) <= 180):
        raise _invalid(where, f"has latitude {a:g} and longitude {b:g}.")
    if deviation is not None and not 0 < deviation < 1e6:
        raise _invalid(where, f"has the accuracy {deviation:g} m.")
    if name in places:
        raise _invalid(where, f"names {name[:100]!r} again.")
    places[name] = MeasuredPlace((a, b, c), deviation)


def _invalid(where: str, detail: str) -> InputError:
    return InputError("positions_invalid", detail, where=where, hint=_HINT)
