"""``sfm_data.json`` of OpenMVG: lenses, poses, points and their observations.

Layout: src/openMVG/sfm/sfm_data_io_cereal.cpp, version 0.3, as cereal writes polymorphic pointers in JSON: a pointer's
first mention has the highest bit of its id set, and so has a type's, which then has its name. A rotation is
cam_from_world by rows, beside the centre; OpenCV axes. pinhole_radial_k3 has k1 to k3, pinhole_brown_t2 also OpenCV's
p1 and p2 (cameras/Camera_Pinhole_Brown.hpp), fisheye is OpenCV's. pinhole_radial_k1 has k1 alone, pinhole nothing
(Camera_Pinhole_Radial_io.hpp, Camera_Pinhole_io.hpp); each has its coefficients under a key of its own.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel

from biresnerf.data.formats.codec import BROWN, FISHEYE, Codec, LensLimits, head_holds
from biresnerf.data.formats.colmap.model_checks import listed_name
from biresnerf.data.formats.parsed_poses import ParsedPoses
from biresnerf.data.formats.photogrammetry.views import View, listed, parsed_views, pose_of_centre
from biresnerf.data.formats.pose_rows import folder_with_photos, lens_of
from biresnerf.data.model.atomic_file import write_json
from biresnerf.data.model.refined_set import Landmark, RefinedSet
from biresnerf.data.model.untrusted_file import checked, invalid_file, read_json_object
from biresnerf.data.photos.panoramas.panorama import panorama_camera
from biresnerf.geometry.camera.camera_models import Camera, FullParameters
from biresnerf.options.formats import Format

OPENMVG = Format(
    name="openmvg",
    title="sfm_data.json (OpenMVG)",
    rank=64,
    found_as=("sfm_data.json",),
    suffixes=(".json",),
    gives="poses and lenses",
    checked_against="its writer; LucasSwitz/OnlineSFM (lenses only)",
    in_set="sfm_data.json",
    loses=("rigs", "mask paths"),
    instead="pinhole",
    lacks="two focal lengths; FULL_OPENCV beyond k3; THIN_PRISM_FISHEYE; colours of points",
    heading="For OpenMVG",
    hint="Set the root path in it to the folder of the photos",
)
_Vector: TypeAlias = tuple[float, float, float]
_FIRST = 2**31  # cereal's mark of what is mentioned for the first time
_VIEW = 2**30  # its id of a pointer to the declared type itself
_TYPES = {
    "pinhole_radial_k3": ("disto_k3", ("k1", "k2", "k3")),
    "pinhole_brown_t2": ("disto_t2", BROWN),
    "fisheye": ("fisheye", FISHEYE),
}


_HINT = "Give the sfm_data.json that OpenMVG wrote, in version 0.3."
_COEFFICIENTS: dict[str, tuple[str, ...]] = {
    "disto_k1": ("k1",), "disto_k3": ("k1", "k2", "k3"), "disto_t2": BROWN, "fisheye": FISHEYE,
}  # fmt: skip


class _View(BaseModel):
    local_path: str = ""
    filename: str
    id_pose: int
    id_intrinsic: int


class _Pose(BaseModel, allow_inf_nan=False):
    rotation: tuple[_Vector, _Vector, _Vector]
    center: _Vector


class _Size(BaseModel):
    """All that a spherical camera has."""

    width: int
    height: int


class _Lens(_Size, allow_inf_nan=False):
    focal_length: float
    principal_point: tuple[float, float]


def parse_openmvg(_root: Path, file: Path) -> ParsedPoses:
    """The views of ``file``; those without a pose have none."""
    document = read_json_object(file)

    def pose(value: Any, where: str) -> NDArray[np.float64]:
        found = checked(_Pose, value, where, _HINT)
        return pose_of_centre(np.array(found.rotation).T, found.center, where)

    def view(value: Any, where: str) -> View:
        found = checked(_View, value, where, _HINT)
        name = listed_name(f"{found.local_path}/{found.filename}".lstrip("/"), f"{where}.filename")
        return View(name, where, str(found.id_pose), str(found.id_intrinsic))

    def numbered(key: str) -> list[tuple[str, Any, str]]:
        rows = listed(document, key, file, _HINT)
        return [
            (str(row.get("key")), row.get("value"), f"{file.name} {key}[{i}]") for i, row in enumerate(rows)
        ]

    poses = {number: partial(pose, value, where) for number, value, where in numbered("extrinsics")}
    lenses = {
        number: partial(_read_lens, _pointed(value), where) for number, value, where in numbered("intrinsics")
    }
    views = [view(_pointed(value), where) for _, value, where in numbered("views")]
    return parsed_views(OPENMVG, file, views, poses, lenses)


def _pointed(value: Any) -> Any:
    """What a pointer of cereal holds."""
    wrapper = value.get("ptr_wrapper") if isinstance(value, dict) else None
    return wrapper.get("data") if isinstance(wrapper, dict) else None


def _read_lens(value: Any, where: str) -> Camera:
    if isinstance(value, dict) and "focal_length" not in value:
        sphere = checked(_Size, value, where, _HINT)
        return panorama_camera(sphere.width, sphere.height, where)
    lens = checked(_Lens, value, where, _HINT)
    key = next((key for key in _COEFFICIENTS if key in value), None)
    names = _COEFFICIENTS[key] if key else ()
    numbers = value[key] if key else []
    if not isinstance(numbers, list) or len(numbers) != len(names):
        raise invalid_file(f"{where} {key}", f"is not {len(names)} numbers.", _HINT)
    coefficients = {
        name: _number(number, f"{where} {key}") for name, number in zip(names, numbers, strict=True)
    }
    focal, (cx, cy) = lens.focal_length, lens.principal_point
    full = FullParameters(focal, focal, cx, cy, **coefficients, fisheye=key == "fisheye")
    return lens_of(full, where, (lens.width, lens.height))


def _number(value: Any, where: str) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise invalid_file(where, "holds something that is not a number.", _HINT)
    return float(value)


def write_openmvg(refined: RefinedSet, path: Path) -> None:
    """Writes the file, whole or not at all. Views, poses and lenses count from 0; ``root_path`` is left empty.

    Raises:
        InputError: ``export_not_possible``: a lens that OpenMVG does not have.
    """
    LensLimits("OpenMVG", two_focal_lengths=False).refuse(refined.cameras, path.name)
    count = len(refined)
    views = [_pointer(row, {"polymorphic_id": _VIEW}, row + 1, _view(refined, row)) for row in range(count)]
    lenses: list[dict[str, Any]] = []
    seen: list[str] = []
    for index, camera in enumerate(refined.cameras):
        kind = _type_of(camera)
        named: dict[str, Any] = {"polymorphic_id": seen.index(kind) + 1} if kind in seen else {}
        if kind not in seen:
            seen.append(kind)
            named = {"polymorphic_id": _FIRST + len(seen), "polymorphic_name": kind}
        lenses.append(_pointer(index, named, count + index + 1, _lens(camera, kind)))
    document = {
        "sfm_data_version": "0.3",
        "root_path": "",
        "views": views,
        "intrinsics": lenses,
        "extrinsics": [
            {"key": row, "value": {"rotation": pose[:3, :3].T.tolist(), "center": pose[:3, 3].tolist()}}
            for row, pose in enumerate(refined.world_from_cam)
        ],
        "structure": [_landmark(one) for one in refined.landmarks()],
        "control_points": [],
    }
    write_json(path, document)


def _pointer(key: int, named: dict[str, Any], number: int, data: dict[str, Any]) -> dict[str, Any]:
    return {"key": key, "value": {**named, "ptr_wrapper": {"id": _FIRST + number, "data": data}}}


def _view(refined: RefinedSet, row: int) -> dict[str, Any]:
    camera, image = refined.camera_of(row), refined.images[row]
    size = {"width": camera.width, "height": camera.height}
    ids = {"id_view": row, "id_intrinsic": image.camera, "id_pose": row}
    return {"local_path": "", "filename": image.file_name, **size, **ids}


def _type_of(camera: Camera) -> str:
    full = camera.full()
    if full.fisheye:
        return "fisheye"
    return "pinhole_brown_t2" if full.p1 or full.p2 else "pinhole_radial_k3"


def _lens(camera: Camera, kind: str) -> dict[str, Any]:
    full, (key, names) = camera.full(), _TYPES[kind]
    return {
        "width": camera.width,
        "height": camera.height,
        "focal_length": full.fx,
        "principal_point": [full.cx, full.cy],
        key: [getattr(full, name) for name in names],
    }


def _landmark(landmark: Landmark) -> dict[str, Any]:
    observations = [
        {"key": row, "value": {"id_feat": feature, "x": xy}} for row, (feature, xy) in landmark.seen.items()
    ]
    return {"key": landmark.number, "value": {"X": landmark.xyz, "observations": observations}}


CODECS = (
    Codec(
        OPENMVG,
        parse=parse_openmvg,
        recognises=head_holds(b'"sfm_data_version"'),
        image_root=folder_with_photos,
        write=lambda refined, path, _: write_openmvg(refined, path),
        given_back=lambda dataset: dataset.source.dialect == "openmvg",
    ),
)
