"""OpenDroneMap's ``odm_report/shots.geojson``: where each photo was taken, in metres of the project's UTM zone.

``translation`` is the centre, ``rotation`` the axis times the angle of cam_from_world, OpenCV axes: opendm/shots.py of
OpenDroneMap/ODM. Lenses are OpenSfM's, in cameras.json of the project; with several, a shot's ``focal`` alone is known.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from pydantic import BaseModel

from biresnerf.data.formats.codec import Codec, head_holds
from biresnerf.data.formats.parsed_poses import LensOf, ParsedPoses
from biresnerf.data.formats.photogrammetry.opensfm import read_lens, world_from_cam_of_vector
from biresnerf.data.formats.pose_rows import Placed, folder_with_photos, named_rows, parsed_rows
from biresnerf.data.model.untrusted_file import checked, invalid_file, read_json_object
from biresnerf.geometry.camera.camera_models import Camera
from biresnerf.options.formats import Format

ODM = Format(
    name="odm",
    title="shots.geojson (OpenDroneMap)",
    rank=67,
    found_as=("odm_report/shots.geojson", "shots.geojson"),
    suffixes=(".geojson",),
    gives="poses in the project's UTM zone, lenses from cameras.json",
    checked_against="its source; a real project",
)
_HINT = "Give odm_report/shots.geojson as OpenDroneMap wrote it, in the folder of the project."
_LENSES = "cameras.json"
_Vector: TypeAlias = tuple[float, float, float]


class _Shot(BaseModel, allow_inf_nan=False):
    rotation: _Vector
    translation: _Vector
    focal: float = 0.0
    width: int = 0
    height: int = 0


def parse_odm(root: Path, file: Path) -> ParsedPoses:
    """The shots of ``file``, each for the photo of its name.

    Raises:
        InputError: codes as in docs/input.md.
    """
    features = read_json_object(file).get("features")
    if not isinstance(features, list) or not features:
        raise invalid_file(f"{file.name} features", "has no list of shots.", _HINT)
    lens_files = [path for path in (root / _LENSES, file.parent.parent / _LENSES) if path.is_file()][:1]
    shared = _shared_lens(lens_files[0]) if lens_files else None

    def read(value: Any, where: str) -> Placed:
        shot = checked(_Shot, value, where, _HINT)
        pose = world_from_cam_of_vector(shot.rotation, (0.0, 0.0, 0.0), where)
        pose[:3, 3] = shot.translation
        if shared is not None or not shot.focal:
            return np.asarray(pose), shared
        return np.asarray(pose), read_lens(shot.model_dump(include={"focal", "width", "height"}), where)

    shots = [one.get("properties") if isinstance(one, dict) else None for one in features]
    rows = named_rows(shots, f"{file.name} features", "filename", _HINT)
    return parsed_rows(ODM, [file, *lens_files], rows, read)


def _shared_lens(file: Path) -> Camera | LensOf | None:
    """The lens of a project with one camera; None where it has several, as shots do not name theirs."""
    cameras: dict[str, Any] = read_json_object(file)
    if len(cameras) != 1:
        return None
    key, value = next(iter(cameras.items()))
    return read_lens(value, f"{file.name} {key}")


CODECS = (
    Codec(ODM, parse=parse_odm, recognises=head_holds(b'"translation"'), image_root=folder_with_photos),
)
