"""RealityCapture's XMP beside each photo: pose and lens.

The program's source is closed. Axes and units: its support article "RealityCapture XMP camera math": the rotation is
cam_from_world by rows, OpenCV axes, beside the camera's centre; lengths as in the csv. Coefficients are k1 to k4, t1
and t2; t1 is OpenCV's p2 and t2 its p1, as AliceVision (src/software/convert/main_importKnownPoses.cpp) and camorph
take them. nerfstudio takes those of the csv the other way round; both are zero unless a model with tangential
distortion was chosen.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from biresnerf.data.formats.codec import Codec, head_holds
from biresnerf.data.formats.parsed_poses import LensOf, ParsedPoses
from biresnerf.data.formats.photogrammetry.realitycapture import FilmLens, lens_on_film
from biresnerf.data.formats.photogrammetry.views import pose_of_centre
from biresnerf.data.formats.photogrammetry.xml_file import read_xml
from biresnerf.data.formats.pose_rows import Placed, parsed_rows
from biresnerf.data.model.untrusted_file import finite_numbers
from biresnerf.errors import InputError
from biresnerf.options.formats import Format

REALITYCAPTURE_XMP = Format(
    name="realitycapture-xmp",
    title="RealityCapture XMP",
    rank=66,
    found_as=("images", "."),
    gives="an .xmp beside each photo",
    checked_against="its article on camera maths; KU-Leuven-Geomatics/geomapi",
)
_HINT = "Export the XMP again, with poses and Brown3 distortion or none."
_MODELS = ("perspective", "brown3", "brown3t2", "brown4", "brown4t2", "division")
_AS_SQUARE, _NO_SKEW = 1e-6, 1e-6
_begins_so = head_holds(b"capturingreality.com/ns/xcr")


def parse_realitycapture_xmp(_root: Path, place: Path) -> ParsedPoses:
    """The poses of the XMP files in ``place``; photos without one, or whose file has only a lens, have none.

    Raises:
        InputError: codes as in docs/input.md.
    """
    files = [path for path in sorted(place.glob("*.xmp")) if _begins_so(path)]
    rows = [(f"{path.stem}.jpg", path.name, path) for path in files]
    return parsed_rows(REALITYCAPTURE_XMP, files, rows, _read, take_file_names=True)


def _read(file: Path, where: str) -> Placed:
    values = {}
    for element in read_xml(file, _HINT).iter():
        for key, text in [*element.attrib.items(), (element.tag, element.text or "")]:
            if "capturingreality.com/ns/xcr" in key and text.strip():
                values[key.rpartition("}")[2]] = text

    def numbers(key: str, count: int) -> list[float]:
        found: list[float] = finite_numbers(values[key].split(), f"{where} xcr:{key}", _HINT, count).tolist()
        return found

    lens = _lens(values, {key: numbers(key, 1)[0] for key in _LENS_KEYS if key in values}, numbers, where)
    if "Position" not in values or "Rotation" not in values:
        return None, lens
    rotation = np.array(numbers("Rotation", 9)).reshape(3, 3)
    return pose_of_centre(rotation.T, numbers("Position", 3), f"{where} xcr:Rotation"), lens


_LENS_KEYS = ("FocalLength35mm", "PrincipalPointU", "PrincipalPointV", "Skew", "AspectRatio")


def _lens(
    values: dict[str, str], given: dict[str, float], numbers: Callable[[str, int], list[float]], where: str
) -> LensOf | None:
    """The lens; None where the file has no focal length."""
    if "FocalLength35mm" not in given:
        return None
    model = values.get("DistortionModel", "perspective")
    k1, k2, k3, k4, t1, t2 = (
        numbers("DistortionCoeficients", 6) if "DistortionCoeficients" in values else [0.0] * 6
    )
    problem = None
    if model not in _MODELS or (model == "division" and k1):
        problem = f"the distortion model {model[:40]}"
    elif abs(given.get("AspectRatio", 1.0) - 1.0) > _AS_SQUARE or abs(given.get("Skew", 0.0)) > _NO_SKEW:
        problem = "a lens with skew, or whose pixels are not square,"
    if problem:
        raise InputError("camera_model_unsupported", f"{problem} is not supported.", where=where, hint=_HINT)
    u, v = given.get("PrincipalPointU", 0.0), given.get("PrincipalPointV", 0.0)
    return lens_on_film(FilmLens(given["FocalLength35mm"], u, v, (k1, k2, k3, k4), (t2, t1)), where)


def _recognises(place: Path) -> bool:
    return place.is_dir() and any(_begins_so(path) for path in sorted(place.glob("*.xmp")))


CODECS = (
    Codec(
        REALITYCAPTURE_XMP,
        parse=parse_realitycapture_xmp,
        recognises=_recognises,
        pose_place=lambda file: file.parent if file.suffix.lower() == ".xmp" else None,
        image_root=lambda place: place.parent if place.name == "images" else place,
    ),
)
