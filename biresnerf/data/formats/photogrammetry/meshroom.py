"""``cameras.sfm`` of Meshroom (AliceVision): lenses, poses, points and their observations.

Layout: src/aliceVision/sfmDataIO/jsonIO.cpp and jsonIO.hpp, version 1.0.0, which later versions read as well: one
focal length and the principal point in pixels. Numbers are strings, as Boost's property tree writes them. A rotation
is cam_from_world by columns (saveMatrix goes through Eigen's storage), beside the centre; OpenCV axes. radial3 has k1
to k3, brown also OpenCV's p1 and p2 (camera/PinholeBrown.hpp), fisheye4 is OpenCV's fisheye.

What later versions changed is in loadIntrinsic there: two focal lengths from 1.2.0, the principal point from the centre
from 1.2.1, millimetres from 1.2.2, and which of the two focal lengths they mean in 1.2.5 and 1.2.11
(camera/IntrinsicScaleOffset.cpp); types and distortions apart from 1.2.8 (camera/cameraCommon.hpp).
"""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel

from biresnerf.data.formats.codec import BROWN, FISHEYE, Codec, LensLimits, head_holds
from biresnerf.data.formats.colmap.model_checks import listed_name, unsupported
from biresnerf.data.formats.parsed_poses import ParsedPoses
from biresnerf.data.formats.photogrammetry.views import View, listed, parsed_views, pose_of_centre
from biresnerf.data.formats.pose_rows import folder_with_photos, lens_of
from biresnerf.data.model.atomic_file import write_json
from biresnerf.data.model.refined_set import Landmark, RefinedSet
from biresnerf.data.model.untrusted_file import checked, invalid_file, read_json_object
from biresnerf.data.photos.panoramas.panorama import panorama_camera
from biresnerf.geometry.camera.camera_models import Camera, FullParameters
from biresnerf.options.formats import Format

MESHROOM = Format(
    name="meshroom",
    title="cameras.sfm (Meshroom)",
    rank=63,
    found_as=("cameras.sfm", "sfm.sfm"),
    suffixes=(".sfm",),
    gives="poses and lenses; versions 1.0.0 to 1.2.12",
    checked_against="its writer; ledionkalludra/LoD2to3",
    in_set="cameras.sfm",
    loses=("rigs", "mask paths"),
    instead="pinhole",
    lacks="two focal lengths; FULL_OPENCV beyond k3; THIN_PRISM_FISHEYE",
    heading="For Meshroom",
    hint="Poses, lenses and points for AliceVision's nodes; paths are relative to the photos' folder",
)
_VERSION = (1, 0, 0)
_RADIAL = ("k1", "k2", "k3")


_HINT = "Give the cameras.sfm that Meshroom's StructureFromMotion wrote."
_LENSES: dict[str, tuple[str, ...]] = {
    "none": (),
    "pinhole": (),
    "radial1": ("k1",),
    "radialk1": ("k1",),
    "radial3": _RADIAL,
    "radialk3": _RADIAL,
    "brown": BROWN,
    "fisheye4": FISHEYE,
    "fisheye": FISHEYE,
}
_Pair: TypeAlias = tuple[float, float]


class _View(BaseModel):
    path: str
    poseId: str = ""  # noqa: N815
    intrinsicId: str = ""  # noqa: N815
    rigId: str = ""  # noqa: N815
    isPoseIndependant: bool = True  # noqa: N815


class _Transform(BaseModel, allow_inf_nan=False):
    rotation: tuple[float, float, float, float, float, float, float, float, float]
    center: tuple[float, float, float]


class _Lens(BaseModel, allow_inf_nan=False):
    type: str
    distortionType: str = "none"  # noqa: N815
    undistortionType: str = "none"  # noqa: N815
    width: int
    height: int
    sensorWidth: float = 36.0  # noqa: N815
    pxFocalLength: float | _Pair = 0.0  # noqa: N815
    focalLength: float = 0.0  # noqa: N815
    pixelRatio: float = 1.0  # noqa: N815
    principalPoint: _Pair  # noqa: N815
    distortionParams: list[float] | str = ""  # noqa: N815


def parse_meshroom(_root: Path, file: Path) -> ParsedPoses:
    """The views of ``file``; those without a pose have none."""
    document = read_json_object(file)
    numbers = document.get("version")
    words = [str(number) for number in numbers] if isinstance(numbers, list) else []
    if len(words) != 3 or not all(word.isdecimal() for word in words):
        raise invalid_file(f"{file.name} version", "is not three numbers.", _HINT)
    version = tuple(map(int, words))

    def pose(row: dict[str, Any], where: str) -> NDArray[np.float64]:
        inner = row.get("pose")
        transform = inner.get("transform") if isinstance(inner, dict) else None
        found = checked(_Transform, transform, f"{where}.pose.transform", _HINT)
        return pose_of_centre(np.array(found.rotation).reshape(3, 3), found.center, where)

    def by_number(key: str, number: str) -> dict[str, tuple[dict[str, Any], str]]:
        rows = listed(document, key, file, _HINT) if key in document else []
        return {str(row.get(number)): (row, f"{file.name} {key}[{i}]") for i, row in enumerate(rows)}

    poses = {number: partial(pose, *row) for number, row in by_number("poses", "poseId").items()}
    lenses = {
        number: partial(_read_lens, *row, version)
        for number, row in by_number("intrinsics", "intrinsicId").items()
    }
    rows = listed(document, "views", file, _HINT)
    views = [_view(row, f"{file.name} views[{index}]") for index, row in enumerate(rows)]
    return parsed_views(MESHROOM, file, views, poses, lenses)


def _view(row: dict[str, Any], where: str) -> View:
    view = checked(_View, row, where, _HINT)
    problem = None
    if view.rigId and not view.isPoseIndependant:
        problem = invalid_file(where, "belongs to a rig, whose poses are not read.", "Export without rigs.")
    return View(listed_name(view.path, f"{where}.path"), where, view.poseId, view.intrinsicId, problem)


def _read_lens(row: dict[str, Any], where: str, version: tuple[int, ...]) -> Camera:
    lens = checked(_Lens, row, where, _HINT)
    kind = (lens.type if version < (1, 2, 8) or lens.type != "pinhole" else lens.distortionType).lower()
    names = _LENSES.get(kind)
    if kind == "equirectangular":
        return panorama_camera(lens.width, lens.height, where)
    if names is None or lens.undistortionType != "none":
        raise unsupported(
            where,
            f"the lens {kind[:40]} is not supported.",
            "Supported are pinhole, radial1, radial3, brown and fisheye4, or undistorted photos.",
        )
    values = [float(value) for value in lens.distortionParams]
    if values and len(values) != len(names):
        raise invalid_file(
            f"{where} distortionParams", f"has {len(values)} numbers, not {len(names)}.", _HINT
        )
    fx, fy = _focal_lengths(lens, version)
    cx, cy = lens.principalPoint
    if version >= (1, 2, 1):
        cx, cy = cx + lens.width / 2, cy + lens.height / 2
    coefficients = dict(zip(names, values, strict=False))
    full = FullParameters(fx, fy, cx, cy, **coefficients, fisheye=kind.startswith("fisheye"))
    return lens_of(full, where, (lens.width, lens.height))


def _focal_lengths(lens: _Lens, version: tuple[int, ...]) -> _Pair:
    """Both in pixels, as loadIntrinsic of that version has them."""
    if version < (1, 2, 2):
        px = lens.pxFocalLength
        return px if isinstance(px, tuple) else (px, px)
    if lens.sensorWidth <= 0.0 or lens.pixelRatio <= 0.0:
        return 0.0, 0.0  # refused as no focal length
    focal, ratio = lens.focalLength * lens.width / lens.sensorWidth, lens.pixelRatio
    if version < (1, 2, 5):
        return focal, focal / ratio
    return (focal, focal * ratio) if version < (1, 2, 11) else (focal / ratio, focal)


def write_meshroom(refined: RefinedSet, path: Path) -> None:
    """Writes the file, whole or not at all. Views, poses and lenses count from 1.

    Raises:
        InputError: ``export_not_possible``: a lens that Meshroom does not have.
    """
    LensLimits("Meshroom", two_focal_lengths=False).refuse(refined.cameras, path.name)
    document = {
        "version": _strings(_VERSION),
        "views": [
            {
                **_strings_of(viewId=row, poseId=row, frameId=row, intrinsicId=image.camera + 1),
                "path": image.file_name,
                **_strings_of(
                    width=refined.camera_of(row - 1).width, height=refined.camera_of(row - 1).height
                ),
                "metadata": {},
            }
            for row, image in enumerate(refined.images, start=1)
        ],
        "intrinsics": [_lens(number, camera) for number, camera in enumerate(refined.cameras, start=1)],
        "poses": [
            {
                "poseId": str(row),
                "pose": {
                    "transform": {
                        "rotation": _strings(pose[:3, :3].ravel().tolist()),  # of world_from_cam by rows
                        "center": _strings(pose[:3, 3].tolist()),
                    },
                    "locked": "0",
                },
            }
            for row, pose in enumerate(refined.world_from_cam, start=1)
        ],
        "structure": [_landmark(one) for one in refined.landmarks()],
    }
    write_json(path, document)


def _lens(number: int, camera: Camera) -> dict[str, Any]:
    full = camera.full()
    kind, names = _type_of(full)
    return {
        **_strings_of(intrinsicId=number, width=camera.width, height=camera.height),
        "serialNumber": "",
        "type": kind,
        "initializationMode": "calibrated",
        **_strings_of(pxInitialFocalLength=full.fx, pxFocalLength=full.fx),
        "principalPoint": _strings((full.cx, full.cy)),
        "distortionParams": _strings(getattr(full, name) for name in names),
        "locked": "0",
    }


def _type_of(lens: FullParameters) -> tuple[str, tuple[str, ...]]:
    """AliceVision's name of a lens, and its coefficients in order."""
    if lens.fisheye:
        return "fisheye4", FISHEYE
    return ("brown", BROWN) if lens.p1 or lens.p2 else ("radial3", _RADIAL)


def _landmark(landmark: Landmark) -> dict[str, Any]:
    return {
        "landmarkId": str(landmark.number),
        "descType": "sift",
        "color": _strings(landmark.rgb),
        "X": _strings(landmark.xyz),
        "observations": [
            {**_strings_of(observationId=row + 1, featureId=feature), "x": _strings(xy)}
            for row, (feature, xy) in landmark.seen.items()
        ],
    }


def _strings(values: Any) -> list[str]:
    return [repr(value) for value in values]


def _strings_of(**values: float) -> dict[str, str]:
    return {name: repr(value) for name, value in values.items()}


CODECS = (
    Codec(
        MESHROOM,
        parse=parse_meshroom,
        recognises=head_holds(b'"version"'),
        image_root=folder_with_photos,
        write=lambda refined, path, _: write_meshroom(refined, path),
        given_back=lambda dataset: dataset.source.dialect == "meshroom",
    ),
)
