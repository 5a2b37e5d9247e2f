"""``reconstruction.json`` of OpenSfM and OpenDroneMap: lenses, poses and points; and OpenDroneMap's ``shots.geojson``.

Layout and conventions: opensfm/io.py (camera_to_json, shot_to_json, point_to_json) and opensfm/features.py
(normalized_image_coordinates) of mapillary/OpenSfM. A rotation is the axis times the angle of cam_from_world, OpenCV
axes. Lengths in the picture are shares of its longer side, from its centre, where a picture's corner lies half a
pixel from the first pixel's middle, as here. p1 and p2 are OpenCV's. The lenses' formulas are in
opensfm/src/geometry/camera_distortions_functions.h: perspective and fisheye have k1 and k2 and one focal length.

``odm_report/shots.geojson`` says where each photo was taken, in metres of the project's UTM zone: ``translation`` is
the centre, ``rotation`` as in OpenSfM: opendm/shots.py of OpenDroneMap/ODM. Lenses are OpenSfM's, in cameras.json of
the project; with several, a shot's ``focal`` alone is known.
"""

from __future__ import annotations

import math
from functools import cache, partial
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel

from biresnerf.data.formats.bad_frames import attempt
from biresnerf.data.formats.codec import BROWN, FISHEYE, Codec, LensLimits, head_holds
from biresnerf.data.formats.colmap.model_checks import image_name, unsupported
from biresnerf.data.formats.parsed_poses import LensOf, ParsedPoses, panorama_lens
from biresnerf.data.formats.pose_rows import (
    Placed,
    Row,
    at_size_of,
    folder_with_photos,
    lens_of_shares,
    named_rows,
    parsed_rows,
    pose_by,
)
from biresnerf.data.model.atomic_file import write_json
from biresnerf.data.model.refined_set import RefinedSet
from biresnerf.data.model.untrusted_file import checked, invalid_file, read_json, read_json_object
from biresnerf.data.photos.photo_folders import IMAGE_FOLDER
from biresnerf.errors import InputError
from biresnerf.geometry.camera.camera_models import Camera, FullParameters
from biresnerf.geometry.rigid import rotation_of, rotation_vectors
from biresnerf.options.formats import Format

OPENSFM = Format(
    name="opensfm",
    title="reconstruction.json (OpenSfM)",
    rank=62,
    found_as=("reconstruction.json", "opensfm/reconstruction.json"),
    suffixes=(".json",),
    gives="poses and lenses of the largest reconstruction",
    checked_against="its writer; arjunkurup/sfm-data-bathtub",
    cam_from_world=True,
    in_set="reconstruction.json",
    loses=("rigs", "mask paths"),
    instead="pinhole",
    lacks="FULL_OPENCV beyond k3; THIN_PRISM_FISHEYE",
    heading="For OpenSfM, OpenDroneMap",
    hint="Put it into the folder of the project; photos are in its images/",
)
ODM = Format(
    name="odm",
    title="shots.geojson (OpenDroneMap)",
    rank=67,
    found_as=("odm_report/shots.geojson", "shots.geojson"),
    suffixes=(".geojson",),
    gives="poses in the project's UTM zone, lenses from cameras.json",
    checked_against="its source; a real project",
)
_HINT = "Give the reconstruction.json that OpenSfM or OpenDroneMap wrote."
_ODM_HINT = "Give odm_report/shots.geojson as OpenDroneMap wrote it, in the folder of the project."
_LENS_FILE = "cameras.json"
_Vector: TypeAlias = tuple[float, float, float]
# The coefficients of each lens that is read.
_LENSES: dict[str, tuple[str, ...]] = {
    "perspective": ("k1", "k2"),
    "simple_radial": ("k1",),
    "radial": ("k1", "k2"),
    "brown": BROWN,
    "fisheye": ("k1", "k2"),
    "fisheye_opencv": FISHEYE,
}


class _Shot(BaseModel, allow_inf_nan=False):
    rotation: _Vector
    translation: _Vector
    camera: str


class _Lens(BaseModel, allow_inf_nan=False):
    """One focal length, or two and a principal point; coefficients that a lens does not name are left alone."""

    projection_type: str = "perspective"
    width: int = 0
    height: int = 0
    focal: float = 0.0
    focal_x: float = 0.0
    focal_y: float = 0.0
    c_x: float = 0.0
    c_y: float = 0.0
    k1: float = 0.0
    k2: float = 0.0
    k3: float = 0.0
    k4: float = 0.0
    p1: float = 0.0
    p2: float = 0.0


def parse_opensfm(_root: Path, file: Path) -> ParsedPoses:
    """The shots of the reconstruction that has most of them."""
    document = read_json(file)
    parts = [part for part in document if isinstance(part, dict)] if isinstance(document, list) else []
    sizes = [len(part["shots"]) if isinstance(part.get("shots"), dict) else 0 for part in parts]
    if not any(sizes):
        raise invalid_file(file.name, "holds no reconstruction with shots.", _HINT)
    largest = sizes.index(max(sizes))
    part, place = parts[largest], f"{file.name} [{largest}]"
    listed = part.get("cameras")
    cameras = listed if isinstance(listed, dict) else {}

    @cache
    def lens(key: str) -> Camera | LensOf | InputError:
        return attempt(partial(_read_lens, cameras.get(key), f"{place}.cameras.{key}"))

    def read(value: Any, where: str) -> Placed:
        shot = checked(_Shot, value, where, _HINT)
        pose = _world_from_cam(shot.rotation, shot.translation, where)
        found = lens(shot.camera)
        if isinstance(found, InputError):
            raise found
        return pose, found

    rows: list[Row] = []
    for name, value in part["shots"].items():
        where = f"{place}.shots.{name}"
        rows.append((image_name(name, where), where, value))
    others = sum(sizes) - max(sizes)
    notes = [f"{others} images belong to smaller reconstructions of {file.name}; their poses were not taken"]
    return parsed_rows(OPENSFM, [file], rows, read, notes=notes if others else ())


def _world_from_cam(rotation: _Vector, translation: _Vector, where: str) -> NDArray[np.float64]:
    """``world_from_cam`` [4, 4] of an axis times an angle (radians) and a translation, both of cam_from_world.

    Raises:
        InputError: ``pose_not_finite`` or ``pose_out_of_range``.
    """
    vector = np.array(rotation)
    half = float(np.linalg.norm(vector)) / 2.0
    if half > math.pi * (1 + 1e-6):
        raise InputError(
            "pose_out_of_range",
            f"the rotation is {2 * half:.3g} long, and a whole turn is 6.28: it looks like degrees.",
            where=where,
            hint="Give the axis times the angle in radians, as OpenSfM does: multiply degrees by pi / 180.",
        )
    return pose_by(OPENSFM, np.column_stack([rotation_of(vector), translation]), where)


def _read_lens(value: Any, where: str) -> Camera | LensOf:
    """A camera's entry as a lens. Raises InputError ``camera_model_unsupported`` or another code for a wrong value."""
    lens = checked(_Lens, value, where, _HINT)
    kind = lens.projection_type
    if kind in ("spherical", "equirectangular"):
        return panorama_lens
    if kind not in _LENSES:
        raise unsupported(
            where, f"the camera type {kind[:40]} is not supported.", f"Supported are {', '.join(_LENSES)}."
        )
    focal_x, focal_y = (lens.focal_x, lens.focal_y) if lens.focal_x else (lens.focal, lens.focal)
    coefficients = {name: getattr(lens, name) for name in _LENSES[kind]}

    at = lens_of_shares(
        FullParameters(
            focal_x, focal_y, lens.c_x, lens.c_y, **coefficients, fisheye=kind.startswith("fisheye")
        ),
        where,
    )
    return at_size_of(at) if not (lens.width and lens.height) else at(lens.width, lens.height)


def write_opensfm(refined: RefinedSet, path: Path) -> None:
    """Writes the file, whole or not at all: one reconstruction.

    Photos are named by their path in images/, where OpenSfM has them.

    Raises:
        InputError: ``export_not_possible``: a lens that OpenSfM does not have.
    """
    LensLimits("OpenSfM").refuse(refined.cameras, path.name)
    shots = {}
    for image, pose in zip(refined.images, refined.cam_from_world, strict=True):
        shots[image.file_name.removeprefix(f"{IMAGE_FOLDER}/")] = {
            "rotation": rotation_vectors(pose[:3, :3]).tolist(),
            "translation": pose[:3, 3].tolist(),
            "camera": str(image.camera),
            "orientation": 1,
        }
    write_json(
        path,
        [
            {
                "cameras": {str(index): _lens(camera) for index, camera in enumerate(refined.cameras)},
                "shots": shots,
                "points": {
                    str(one.number): {"coordinates": one.xyz, "color": one.rgb} for one in refined.landmarks()
                },
            }
        ],
    )


def _lens(camera: Camera) -> dict[str, Any]:
    full, size = camera.full(), max(camera.width, camera.height)
    return {
        "projection_type": "fisheye_opencv" if full.fisheye else "brown",
        "width": camera.width,
        "height": camera.height,
        "focal_x": full.fx / size,
        "focal_y": full.fy / size,
        "c_x": (full.cx - camera.width / 2) / size,
        "c_y": (full.cy - camera.height / 2) / size,
        **{name: getattr(full, name) for name in (FISHEYE if full.fisheye else BROWN)},
    }


class _OdmShot(BaseModel, allow_inf_nan=False):
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
        raise invalid_file(f"{file.name} features", "has no list of shots.", _ODM_HINT)
    lens_files = [path for path in (root / _LENS_FILE, file.parent.parent / _LENS_FILE) if path.is_file()][:1]
    shared = _shared_lens(lens_files[0]) if lens_files else None

    def read(value: Any, where: str) -> Placed:
        shot = checked(_OdmShot, value, where, _ODM_HINT)
        pose = _world_from_cam(shot.rotation, (0.0, 0.0, 0.0), where)
        pose[:3, 3] = shot.translation
        if shared is not None or not shot.focal:
            return np.asarray(pose), shared
        return np.asarray(pose), _read_lens(shot.model_dump(include={"focal", "width", "height"}), where)

    shots = [one.get("properties") if isinstance(one, dict) else None for one in features]
    rows = named_rows(shots, f"{file.name} features", "filename", _ODM_HINT)
    return parsed_rows(ODM, [file, *lens_files], rows, read)


def _shared_lens(file: Path) -> Camera | LensOf | None:
    """The lens of a project with one camera; None where it has several, as shots do not name theirs."""
    cameras: dict[str, Any] = read_json_object(file)
    if len(cameras) != 1:
        return None
    key, value = next(iter(cameras.items()))
    return _read_lens(value, f"{file.name} {key}")


CODECS = (
    Codec(
        OPENSFM,
        parse=parse_opensfm,
        recognises=head_holds(b'"cameras"'),
        image_root=folder_with_photos,
        write=lambda refined, path, _: write_opensfm(refined, path),
        given_back=lambda dataset: dataset.source.dialect == "opensfm",
    ),
    Codec(ODM, parse=parse_odm, recognises=head_holds(b'"translation"'), image_root=folder_with_photos),
)
