"""The measured positions in a Metashape camera export: its references, with the accuracy of each or of the chunk."""

from __future__ import annotations

import re
from pathlib import Path

from biresnerf.data.formats.photogrammetry.metashape import cameras_by_label, the_chunk
from biresnerf.data.formats.positions.position_table import EPSG, WGS84, PositionTable, is_geographic
from biresnerf.data.model.untrusted_file import finite_numbers
from biresnerf.data.photos.geotags import MeasuredPlace

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
