"""The measured positions of a set's photos in metres: of a table beside them, Metashape's references, or EXIF."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np

from biresnerf.data.formats.match_names import match_files
from biresnerf.data.formats.photogrammetry.metashape import cameras_by_label, the_chunk
from biresnerf.data.formats.positions.position_table import (
    EPSG,
    FLAT,
    WGS84,
    PositionTable,
    is_geographic,
    position_files,
    read_position_table,
)
from biresnerf.data.model.dataset import Dataset
from biresnerf.data.model.measured_places import PositionPriors
from biresnerf.data.model.untrusted_file import finite_numbers, read_text
from biresnerf.data.photos.geotags import MeasuredPlace, lacks_height, read_geotag
from biresnerf.errors import InputError
from biresnerf.geometry.earth.geodesy import east_north_up, held_so

FEW = 5  # photos that are opened to see whether any has a position without a height


def position_priors(dataset: Dataset) -> PositionPriors | None:
    """The positions that the set has, or of the first source that has some: a table, Metashape's references, EXIF.

    Raises:
        InputError: ``positions_invalid``, or a code of `open_image`.
    """
    if dataset.positions is not None:
        return dataset.positions
    if dataset.cut is not None:
        # Of a panorama's views the first alone, so that its position counts once.
        found = position_priors(dataset.cut.whole)
        # The angles of a gimbal are none of a panorama that was made of many photos.
        return found and replace(found, rows=dataset.cut.firsts[found.rows], rotations=None)
    table, _ = _of_table(dataset)
    for one in (table, _of_metashape(dataset)):
        if one is not None and (places := _by_frame(dataset, one)):
            if one.in_degrees:
                tags = _tags(dataset)
                places = {
                    i: p._replace(angles_deg=tags[i].angles_deg if i in tags else None)
                    for i, p in places.items()
                }
            return _priors(one.source, places, one.epsg, in_degrees=one.in_degrees)
    tags = _tags(dataset)
    return _priors("EXIF", tags, WGS84, in_degrees=True) if tags else None


def _tags(dataset: Dataset) -> dict[int, MeasuredPlace]:
    """The positions in the photos' own metadata, by frame."""
    return {i: tag for i, f in enumerate(dataset.frames) if (tag := read_geotag(f.path, f.name)) is not None}


def position_notes(dataset: Dataset) -> tuple[str, ...]:
    """Notes on how many photos a table beside them has positions for, and on photos whose own have no height.

    Raises:
        InputError: ``positions_invalid``, or a code of `open_image`.
    """
    table, notes = _of_table(dataset)
    if table is not None:
        return notes
    frames = dataset.frames
    # A device writes heights or does not: some photos show whether all are to be opened.
    some = {frames[i] for i in np.linspace(0, len(frames) - 1, FEW).astype(int).tolist()}
    if not any(lacks_height(frame.path, frame.name) for frame in some):
        return notes
    flat = sum(lacks_height(frame.path, frame.name) for frame in frames)
    note = f"{flat} of {len(frames)} photos have a GPS position without altitude, which is not used, {FLAT}"
    return (*notes, note)


def _of_table(dataset: Dataset) -> tuple[PositionTable | None, tuple[str, ...]]:
    """The first table beside the photos that has positions of some, and notes on it and those before it.

    Raises:
        InputError: ``positions_invalid`` for one that names photos of the set and cannot be read.
    """
    notes: list[str] = []
    for file in position_files(dataset.root):
        try:
            table = read_position_table(file)
        except InputError as error:
            if _names_photos(file, dataset):
                raise
            what = f"{error.where} {error.detail.removesuffix('.')}"
            notes.append(f"{what}; it names no photo of the set and is not used")
            continue
        count = len(_by_frame(dataset, table))
        notes += [f"{table.source}: measured positions of {count} of {len(dataset)} photos", *table.notes]
        if count:
            return table, tuple(notes)
    return None, tuple(notes)


def _names_photos(file: Path, dataset: Dataset) -> bool:
    """Whether a cell of the table is the name of a photo, with its extension or more than a number."""
    try:
        cells = set(re.split(r"[,;\t\s\"]+", read_text(file).casefold()))
    except InputError:
        return False
    names = [frame.path for frame in dataset.frames]
    return any(
        path.name.casefold() in cells or (not path.stem.isdecimal() and path.stem.casefold() in cells)
        for path in names
    )


def _of_metashape(dataset: Dataset) -> PositionTable | None:
    if dataset.source.dialect != "metashape" or not dataset.source.files:
        return None
    return read_references(dataset.source.files[0])


def _by_frame(dataset: Dataset, table: PositionTable) -> dict[int, MeasuredPlace]:
    """Places by frame, with names compared as those of pose files are."""
    found, _ = match_files(list(table.places), dataset.file_names)
    index_of = {name: index for index, name in enumerate(dataset.file_names)}
    return {index_of[file]: table.places[name] for name, file in found.items()}


def _priors(
    source: str, found: dict[int, MeasuredPlace], epsg: int | None, *, in_degrees: bool
) -> PositionPriors:
    places = np.array([place.place for place in found.values()], dtype=np.float64)
    accuracy = np.array([p.accuracy_m or (np.nan,) * 3 for p in found.values()])
    rows = np.array(list(found), dtype=np.int64)
    if not in_degrees:
        return PositionPriors(source, rows, places, accuracy, None, epsg)
    origin = np.median(places, axis=0)
    latitude, longitude, height = origin.tolist()
    angles = np.array([place.angles_deg or (np.nan,) * 3 for place in found.values()])
    rotations = held_so(angles) if np.isfinite(angles).any() else None
    return PositionPriors(
        source, rows, east_north_up(places, origin), accuracy, (latitude, longitude, height), epsg, rotations
    )


_HINT = "Export the cameras from Metashape again."


def read_references(file: Path) -> PositionTable | None:
    """The references by the cameras' labels; None where the chunk has none.

    Raises:
        InputError: ``pose_file_invalid``.
    """
    chunk = the_chunk(file)
    system = chunk.findtext("reference", "").strip()
    if not system:
        return None
    degrees, numbers = is_geographic(system), re.findall(EPSG, system)
    axes = "yxz" if degrees else "xyz"
    properties = {one.get("name"): one.get("value") for one in chunk.iter("property")}
    places: dict[str, MeasuredPlace] = {}
    for label, camera in cameras_by_label(chunk, file).items():
        reference = camera.find("reference")
        if reference is None or reference.get("enabled") in ("0", "false"):
            continue
        texts = [text for axis in axes if (text := reference.get(axis)) is not None]
        if len(texts) < 3:
            continue
        where = f"{file.name} camera {label!r} reference"
        stated = reference.get("sxyz") or properties.get("accuracy_cameras")
        a, b, c, accuracy = finite_numbers([*texts, stated or "0"], where, _HINT).tolist()
        places[label] = MeasuredPlace((a, b, c), (accuracy,) * 3 if accuracy > 0 else None)
    epsg = WGS84 if degrees else int(numbers[-1]) if numbers else None
    return PositionTable(file.name, places, degrees, epsg) if places else None
