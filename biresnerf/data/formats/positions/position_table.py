"""Tables of where photos were taken: csv with a header, Metashape's reference file, OpenDroneMap's geo.txt."""

from __future__ import annotations

import math
import re
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from pathlib import Path

from biresnerf.data.model.untrusted_file import read_table, read_text, read_words
from biresnerf.data.photos.geotags import MeasuredPlace
from biresnerf.errors import InputError

# Looked for in the folder of the photos, in this order, whatever their case.
POSITION_FILES = ("positions.csv", "gps.csv", "geotags.csv", "reference.csv", "reference.txt", "geo.txt")
WGS84 = 4979  # EPSG's number of latitude, longitude and ellipsoidal height
EPSG = r'AUTHORITY\["EPSG",\s*"(\d+)"\]'  # in the text form of a frame, the last one is its own
# Geographic frames whose numbers people write most: WGS 84, ETRS89, NAD83. Others are detected by what they hold.
_DEGREES = frozenset({4326, WGS84, 4258, 4269})
_PROJECTED = (range(2000, 4000), range(20000, 33000))
_METRES = {"m": 1.0, "km": 1000.0, "ft": 0.3048, "us-ft": 1200 / 3937}
_HINT = "Write a header line: name,lat,lon,alt[,accuracy] in degrees and metres, or name,x,y,z[,accuracy] in metres."
_GEO_HINT = "Begin with EPSG:4326, then a photo a line: name longitude latitude height, between spaces."
_COLUMNS = {
    "name": ("name", "label", "image", "imagename", "filename", "file", "photo"),
    "lat": ("lat", "latitude"),
    "lon": ("lon", "lng", "long", "longitude"),
    "x": ("x", "easting", "xeasting", "xlongitude"),
    "y": ("y", "northing", "ynorthing", "ylatitude"),
    "z": ("z", "alt", "altitude", "height", "elevation", "zaltitude", "zheight"),
    "accuracy": ("accuracy", "accuracym", "sigma", "std", "xyzaccuracy"),
    "zaccuracy": ("zaccuracy", "accuracyz", "verticalaccuracy", "sigmaz"),
}
FLAT = "as places alone, without heights, do not tell how the scene is tilted"
# Column of geo.txt's horizontal accuracy, after name, position and angles; the vertical one follows.
_ODM_ACCURACY = 7


@dataclass(frozen=True)
class PositionTable:
    """The places that a source states.

    Attributes:
        source: for messages: the file's name.
        places: by the photos' names as the source writes them.
        in_degrees: places are latitude, longitude and height.
        epsg: the frame's number, where it is known.
        notes: for the user.
    """

    source: str
    places: dict[str, MeasuredPlace]
    in_degrees: bool
    epsg: int | None
    notes: tuple[str, ...] = ()


def files_called(root: Path, names: Sequence[str]) -> list[Path]:
    """The files in the folder ``root`` with these names, in any case, in this order."""
    files = {path.name.lower(): path for path in sorted(root.iterdir()) if path.is_file()}
    return [files[name] for name in names if name in files]


def position_files(root: Path) -> list[Path]:
    """The files that are named as tables of positions."""
    return files_called(root, POSITION_FILES)


def is_geographic(frame: str) -> bool:
    """Whether the text form (WKT) of a frame is one of degrees, alone or with a height system."""
    return "GEOG" in frame and not re.search("PROJC|LOCAL_|ENGCRS|GEOCCS", frame)


def read_position_table(file: Path) -> PositionTable:
    """The places in a file.

    Raises:
        InputError: ``positions_invalid``, with the line.
    """
    lines = read_text(file).splitlines()
    blank = next((index for index, line in enumerate(lines) if line.strip()), 0)
    if lines and re.match(r"\s*(EPSG:|WGS84 UTM|'?\+proj)", lines[blank], re.I):
        return _geo_txt(file)
    said = next((line for line in lines if "coordinatesystem" in line.lower().replace(" ", "")), "")
    table = read_table(file.name, lines, _COLUMNS, _is_head)
    if table is None:
        raise _invalid(file.name, "has no header that names a name and three coordinates.")
    header = table.columns
    longitudes = "xlongitude" in re.sub(r"[^a-z\n]", "", "\n".join(lines).lower())
    degrees = "lat" in header or (longitudes and (not said.partition(":")[2] or is_geographic(said)))
    order = ("lat", "lon", "z") if "lat" in header else ("y", "x", "z") if degrees else ("x", "y", "z")
    missing = [name for name in ("name", *order[:2]) if name not in header]
    if missing:
        raise _invalid(f"{file.name}", f"has no column for {', '.join(missing)}.")
    numbers = re.findall(EPSG, said)
    places: dict[str, MeasuredPlace] = {}
    flat: list[str] = []
    for where, row in table.rows:
        name, texts = table.cell(row, "name"), [table.cell(row, name) for name in order]
        if not name or not any(texts):  # Metashape lists photos without a reference, too
            continue
        if all(texts[:2]) and not texts[2]:
            flat.append(where)
            continue
        accuracy = [table.cell(row, key) for key in ("accuracy", "zaccuracy")]
        _add(places, name, texts, accuracy, where, degrees=degrees)
    epsg = WGS84 if degrees else int(numbers[-1]) if numbers else None
    return PositionTable(file.name, places, degrees, epsg, _flat_notes(flat))


def _geo_txt(file: Path) -> PositionTable:
    """OpenDroneMap's: a frame, then names, x (or longitude), y (or latitude), optional height, angles, accuracies."""
    (header, frame), *told = read_words(file)
    for where, cells in told:
        if len(cells) < 3:
            raise _invalid(where, "has less than a name and two numbers.")
    flat = [where for where, cells in told if len(cells) == 3]
    rows = [(where, cells) for where, cells in told if len(cells) > 3]
    degrees, metres, epsg = frame_of(" ".join(frame), [cells[1:] for _, cells in rows], header)
    places: dict[str, MeasuredPlace] = {}
    for where, cells in rows:
        x, y, z = cells[1:4]
        texts = [y, x, z] if degrees else [x, y, z]
        stated = cells[_ODM_ACCURACY : _ODM_ACCURACY + 2]
        _add(places, cells[0], texts, stated, where, degrees=degrees)
        a, b, c = places[cells[0]].place
        places[cells[0]] = places[cells[0]]._replace(place=(a * metres, b * metres, c))
    return PositionTable(file.name, places, degrees, epsg, _flat_notes(flat))


def _flat_notes(places: Sequence[str]) -> tuple[str, ...]:
    if not places:
        return ()
    return (f"{places[0]} has no height: {len(places)} positions without one are not used, {FLAT}",)


def frame_of(header: str, rows: Sequence[Sequence[str]], where: str) -> tuple[bool, float, int | None]:
    """Whether the first line of a geo.txt names a frame of degrees, else its metres per unit, and EPSG's number.

    It is ``EPSG:n``, ``WGS84 UTM 32N`` or a string of PROJ. Few of EPSG's geographic frames are known here. Any other
    is taken as geographic if all coordinates are small, as nobody takes photos at a projection's origin.
    """
    if found := re.fullmatch(r"\s*EPSG:\s*(\d{4,6})\s*", header, re.I):
        number = int(found[1])
        if number in _DEGREES:
            return True, 1.0, WGS84 if number == 4326 else number
        small = all(abs(value) <= 180 for cells in rows for value in map(_number, cells[:2]))
        return small and not any(number in some for some in _PROJECTED), 1.0, number
    if found := re.fullmatch(r"\s*WGS84 UTM (\d{1,2})([NS])\s*", header, re.I):
        return False, 1.0, int(found[1]) + (32700 if found[2] in "Ss" else 32600)
    words = header.strip().strip("'").split()
    terms = {key: value for key, _, value in (word.removeprefix("+").partition("=") for word in words)}
    world = "WGS84" in (terms.get("datum"), terms.get("ellps"))
    if terms.get("proj") in ("longlat", "latlong", "lonlat", "latlon"):
        return True, 1.0, WGS84 if world else None
    try:
        metres = float(terms["to_meter"]) if "to_meter" in terms else _METRES[terms.get("units", "m")]
        zone = int(terms["zone"]) if terms["proj"] == "utm" else 0
    except (KeyError, ValueError):
        raise _invalid(where, f"names no frame that is known: {header.strip()[:100]!r}.") from None
    return False, metres, zone + (32700 if "south" in terms else 32600) if zone and world else None


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return 0.0


def _is_head(found: Collection[str]) -> bool:
    return "name" in found and (len(found) > 3 or {"lat", "lon"} <= {*found} or {"x", "y"} <= {*found})


def _add(
    places: dict[str, MeasuredPlace],
    name: str,
    texts: Sequence[str],
    accuracy: Sequence[str],
    where: str,
    *,
    degrees: bool,
) -> None:
    try:
        a, b, c = (float(text) for text in texts)
        stated = [float(text) for text in accuracy if text]
    except ValueError:
        raise _invalid(where, f"has {', '.join(texts)}, which are not three numbers.") from None
    if not all(math.isfinite(value) and abs(value) < 1e9 for value in (a, b, c)):
        raise _invalid(where, "has numbers that are no position.")
    if degrees and not (abs(a) <= 90 and abs(b) <= 180):
        raise _invalid(where, f"has latitude {a:g} and longitude {b:g}.")
    for deviation in stated:
        if not 0 < deviation < 1e6:
            raise _invalid(where, f"has the accuracy {deviation:g} m.")
    if name in places:
        raise _invalid(where, f"names {name[:100]!r} again.")
    places[name] = MeasuredPlace((a, b, c), (stated[0], stated[0], stated[-1]) if stated else None)


def _invalid(where: str, detail: str) -> InputError:
    hint = _GEO_HINT if where.lower().startswith("geo.txt") else _HINT
    return InputError("positions_invalid", detail, where=where, hint=hint)
