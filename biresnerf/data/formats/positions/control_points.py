"""Ground control points and check points: OpenDroneMap's gcp_list.txt, and csv with a header."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from biresnerf.data.formats.match_names import match_files
from biresnerf.data.formats.positions.markers import is_marker, marked, refuse_without_opencv
from biresnerf.data.formats.positions.position_table import WGS84, files_called, frame_of
from biresnerf.data.model.dataset import Dataset
from biresnerf.data.model.measured_places import ControlPoints
from biresnerf.data.model.untrusted_file import read_table, read_text, read_words
from biresnerf.data.photos.panoramas.cut_panoramas import place_in_view
from biresnerf.errors import InputError
from biresnerf.geometry.earth.geodesy import east_north_up

CONTROL_FILES = ("gcp_list.txt", "gcp_file.txt", "gcp.csv", "control_points.csv")
_HINT = (
    "gcp_list.txt: a frame such as EPSG:32633, then rows of x y z px py image name. gcp.csv: a header with "
    "name,x,y,z,image,px,py, or lat,lon,alt for x,y,z."
)
_CHECKS = {"1", "true", "yes", "check"}
_TITLES = {
    "name": ("name", "label"), "check": ("check",), "image": ("image", "photo", "file"), "px": ("px",), "py": ("py",),
    "lat": ("lat", "latitude"), "lon": ("lon", "longitude"), "x": ("x", "easting"), "y": ("y", "northing"),
    "z": ("z", "alt", "height"), "accuracy": ("accuracy",), "zaccuracy": ("zaccuracy", "accuracyz"),
}  # fmt: skip


@dataclass(frozen=True)
class _Row:
    """A line of a file: a point, and where a photo shows it; empty and NaN where none does."""

    where: str
    name: str
    check: bool
    place: tuple[float, float, float]
    accuracy: tuple[float, float, float]
    image: str
    xy: tuple[float, float]


def control_files(root: Path) -> list[Path]:
    """The files in the folder ``root`` that are named as lists of control points, the preferred one first."""
    return files_called(root, CONTROL_FILES)


def control_points(dataset: Dataset) -> ControlPoints | None:
    """The points that two photos of the set show, from the first file beside the photos; None if there are none.

    Raises:
        InputError: ``control_points_invalid``, with the line; or a code of `decode`, where it names markers.
    """
    given = dataset if dataset.cut is None else dataset.cut.whole
    file = next(iter(control_files(given.root)), None)
    if dataset.control is not None or file is None:
        return dataset.control
    rows, degrees, epsg = _rows_of(file)
    found, _ = match_files(list(dict.fromkeys(row.image for row in rows if row.image)), given.file_names)
    index_of = {name: index for index, name in enumerate(given.file_names)}
    frame = {name: index_of[known] for name, known in found.items()}
    firsts: dict[str, _Row] = {}
    for row in rows:
        if row.place != firsts.setdefault(row.name, row).place:
            raise _invalid(row.where, f"has other coordinates of {row.name[:100]!r} than a line before.")
    number = {name: place for place, name in enumerate(firsts)}
    seen = {}
    for row in rows:
        if row.image in frame and (shown := place_in_view(dataset, frame[row.image], row.xy)) is not None:
            seen[number[row.name], shown[0]] = shown[1]
    if markers := _markers(rows):
        seen |= {(number[name], at): xy for (name, at), xy in marked(dataset, markers).items()}
    if not seen:
        return None
    first = list(firsts.values())
    places, origin = np.array([row.place for row in first]), None
    if degrees:
        origin = tuple(np.median(places, axis=0).tolist())
        places = east_north_up(places, np.array(origin))
    index = np.array(sorted(seen), dtype=np.int64)
    points = ControlPoints(
        file.name, tuple(firsts), places, np.array([row.accuracy for row in first]),
        np.array([row.check for row in first]), index[:, 0], index[:, 1],
        np.array([seen[point, image] for point, image in index.tolist()]), origin, epsg,
    )  # fmt: skip
    points = points.seen_in(np.ones(len(index), dtype=np.bool_))
    return points if points.names else None


def control_notes(dataset: Dataset) -> tuple[str, ...]:
    """A note on what the file beside the photos holds.

    Raises:
        InputError: ``control_points_invalid``, or ``markers_unsupported``.
    """
    file = next(iter(control_files(dataset.root)), None)
    if file is None:
        return ()
    if markers := _markers(_rows_of(file)[0]):  # finding them takes a while
        refuse_without_opencv(file.name)
        return (f"{file.name}: {len(markers)} printed markers are looked for in the photos",)
    points = control_points(dataset)
    if points is None:
        return (f"{file.name}: no control point is seen in two photos of the set; it is not used",)
    checks = int(points.check.sum())
    return (
        f"{points.source}: {len(points.names) - checks} control points and {checks} check points in "
        f"{len(np.unique(points.image))} photos",
    )


def _markers(rows: list[_Row]) -> list[str]:
    """Names of markers for which no row says where photos show them."""
    shown = {row.name for row in rows if row.image}
    return [row.name for row in rows if row.name not in shown and is_marker(row.name)]


def _rows_of(file: Path) -> tuple[list[_Row], bool, int | None]:
    """The rows, whether their places are latitude, longitude and height, and EPSG's number of the frame."""
    return _of_csv(file) if file.suffix.lower() == ".csv" else _of_odm(file)


def _of_odm(file: Path) -> tuple[list[_Row], bool, int | None]:
    """OpenDroneMap's: a frame, then x (or longitude), y, z, the pixel, the photo, and optionally a name."""
    lines = read_words(file)
    if not lines:
        raise _invalid(file.name, "is empty.")
    (header, frame), *told = lines
    degrees, metres, epsg = frame_of(" ".join(frame), [cells for _, cells in told], header)
    rows, unknown = [], (math.nan,) * 3
    for where, cells in told:
        if len(cells) < 6:
            raise _invalid(where, "has less than x y z px py and an image.")
        x, y, z, px, py = _numbers(cells[:5], where)
        name = cells[6] if len(cells) > 6 else " ".join(cells[:3])
        place = (y, x, z) if degrees else (x * metres, y * metres, z)
        rows.append(_Row(where, name, name.upper().startswith("CHK"), place, unknown, cells[5], (px, py)))
    return rows, degrees, epsg


def _of_csv(file: Path) -> tuple[list[_Row], bool, int | None]:
    """A header that names the columns; optionally above it a line with the frame of x, y, z."""
    lines = read_text(file).splitlines()
    epsg = next((int(n) for line in lines[:2] for n in re.findall(r"EPSG:\s*(\d{4,6})", line, re.I)), None)
    table = read_table(file.name, lines, _TITLES, lambda found: "name" in found)
    if table is None:
        raise _invalid(file.name, "has no header with a column `name`.")
    degrees = "lat" in table.columns
    order = ("lat", "lon", "z") if degrees else ("x", "y", "z")
    if missing := [name for name in order if name not in table.columns]:
        raise _invalid(file.name, f"has no column for {', '.join(missing)}.")
    rows = [
        _csv_row({title: table.cell(row, title) for title in _TITLES}, order, where)
        for where, row in table.rows
        if table.cell(row, "name")
    ]
    return rows, degrees, epsg or (WGS84 if degrees else None)


def _csv_row(cell: dict[str, str], order: tuple[str, ...], where: str) -> _Row:
    a, b, c = _numbers([cell[name] for name in order], where)
    across = cell["accuracy"] or "nan"
    e, u = _numbers([across, cell["zaccuracy"] or across], where, finite=False)
    image, xy = cell["image"], (math.nan, math.nan)
    if image:
        px, py = _numbers([cell["px"], cell["py"]], where)
        xy = (px, py)
    return _Row(where, cell["name"], cell["check"].lower() in _CHECKS, (a, b, c), (e, e, u), image, xy)


def _numbers(texts: list[str], where: str, *, finite: bool = True) -> Iterator[float]:
    try:
        numbers = [float(text) for text in texts]
    except ValueError:
        numbers = []
    if (
        not numbers
        or (finite and not all(map(math.isfinite, numbers)))
        or any(n <= 0 for n in numbers if not finite)
    ):
        raise _invalid(
            where, f"has {', '.join(texts)[:100]}, which are not {len(texts)} numbers that can be meant."
        )
    return iter(numbers)


def _invalid(where: str, detail: str) -> InputError:
    return InputError("control_points_invalid", detail, where=where, hint=_HINT)
