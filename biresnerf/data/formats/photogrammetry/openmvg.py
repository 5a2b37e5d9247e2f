"""``sfm_data.json`` of OpenMVG: lenses, poses, points and their observations.

Layout: src/openMVG/sfm/sfm_data_io_cereal.cpp, version 0.3, as cereal writes polymorphic pointers in JSON: a pointer's
first mention has the highest bit of its id set, and so has a type's, which then has its name. A rotation is
cam_from_world by rows, beside the centre; OpenCV axes. pinhole_radial_k3 has k1 to k3, pinhole_brown_t2 also OpenCV's
p1 and p2 (cameras/Camera_Pinhole_Brown.hpp), fisheye is OpenCV's.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from biresnerf.data.formats.codec import Codec
from biresnerf.data.formats.photogrammetry.landmarks import Landmark, landmarks
from biresnerf.data.formats.photogrammetry.lens_limits import BROWN, FISHEYE, refuse_other_lenses
from biresnerf.data.model.atomic_file import write_json
from biresnerf.data.model.refined_set import RefinedSet
from biresnerf.geometry.camera.camera_models import Camera
from biresnerf.options.formats import Format

OPENMVG = Format(
    name="openmvg",
    title="sfm_data.json (OpenMVG)",
    rank=64,
    in_set="sfm_data.json",
    loses=("rigs", "mask paths"),
    instead="pinhole",
    lacks="two focal lengths; FULL_OPENCV beyond k3; colours of points",
    heading="For OpenMVG",
    hint="Set root_path in it to the folder of the photos",
)
_FIRST = 2**31  # cereal's mark of what is mentioned for the first time
_VIEW = 2**30  # its id of a pointer to the declared type itself
_TYPES = {
    "pinhole_radial_k3": ("disto_k3", ("k1", "k2", "k3")),
    "pinhole_brown_t2": ("disto_t2", BROWN),
    "fisheye": ("fisheye", FISHEYE),
}


def write_openmvg(refined: RefinedSet, path: Path) -> None:
    """Writes the file, whole or not at all. Views, poses and lenses count from 0; ``root_path`` is left empty.

    Raises:
        InputError: ``export_not_possible``: a lens that OpenMVG does not have.
    """
    refuse_other_lenses(refined, "OpenMVG", path.name, fisheye=True, two_focal_lengths=False)
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
        "structure": [_landmark(one) for one in landmarks(refined)],
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


CODECS = (Codec(OPENMVG, write=lambda refined, path, _: write_openmvg(refined, path)),)
