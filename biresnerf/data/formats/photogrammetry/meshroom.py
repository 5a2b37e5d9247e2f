"""``cameras.sfm`` of Meshroom (AliceVision): lenses, poses, points and their observations.

Layout: src/aliceVision/sfmDataIO/jsonIO.cpp and jsonIO.hpp, version 1.0.0, which later versions read as well: one
focal length and the principal point in pixels. Numbers are strings, as Boost's property tree writes them. A rotation
is cam_from_world by columns (saveMatrix goes through Eigen's storage), beside the centre; OpenCV axes. radial3 has k1
to k3, brown also OpenCV's p1 and p2 (camera/PinholeBrown.hpp), fisheye4 is OpenCV's fisheye.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from biresnerf.data.formats.codec import Codec
from biresnerf.data.formats.photogrammetry.landmarks import Landmark, landmarks
from biresnerf.data.formats.photogrammetry.lens_limits import BROWN, FISHEYE, refuse_other_lenses
from biresnerf.data.model.atomic_file import write_json
from biresnerf.data.model.refined_set import RefinedSet
from biresnerf.geometry.camera.camera_models import Camera, FullParameters
from biresnerf.options.formats import Format

MESHROOM = Format(
    name="meshroom",
    title="cameras.sfm (Meshroom)",
    rank=63,
    in_set="cameras.sfm",
    loses=("rigs", "mask paths"),
    instead="pinhole",
    lacks="two focal lengths; FULL_OPENCV beyond k3",
    heading="For Meshroom",
    hint="Poses, lenses and points for AliceVision's nodes; paths are relative to the photos' folder",
)
_VERSION = (1, 0, 0)
_RADIAL = ("k1", "k2", "k3")


def write_meshroom(refined: RefinedSet, path: Path) -> None:
    """Writes the file, whole or not at all. Views, poses and lenses count from 1.

    Raises:
        InputError: ``export_not_possible``: a lens that Meshroom does not have.
    """
    refuse_other_lenses(refined, "Meshroom", path.name, fisheye=True, two_focal_lengths=False)
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
        "structure": [_landmark(one) for one in landmarks(refined)],
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


CODECS = (Codec(MESHROOM, write=lambda refined, path, _: write_meshroom(refined, path)),)
