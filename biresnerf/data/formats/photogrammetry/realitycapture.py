"""RealityCapture's csv of internal and external camera parameters, or of positions with angles, and its XMP of photos.

The program's source is closed: columns and conventions of the csv are those by which nerfstudio reads the file
(process_data/realitycapture_utils.py, 1.1.5). Heading (clockwise), pitch and roll are degrees: world_from_cam with
OpenGL axes is Rz(-heading) Rx(pitch) Ry(roll). The focal length is that of a film 36 mm wide; px and py are shares of
the longer side, from the centre; t1 and t2 are OpenCV's p1 and p2. With omega, phi and kappa it is Ry(kappa) Rx(phi)
Rz(-omega), as in the program's XMP files of the same photos, to 1e-13.

Axes and units of an XMP: its support article "RealityCapture XMP camera math": the rotation is cam_from_world by rows,
OpenCV axes, beside the camera's centre; lengths as in the csv. Coefficients are k1 to k4, t1 and t2; t1 is OpenCV's p2
and t2 its p1, as AliceVision (src/software/convert/main_importKnownPoses.cpp) and camorph read them. nerfstudio reads
those of the csv the other way round; both are zero unless a model with tangential distortion was chosen.
"""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path, PurePosixPath

import numpy as np
from numpy.typing import NDArray

from biresnerf.data.formats.codec import Codec, LensLimits, cannot_hold, head_holds
from biresnerf.data.formats.colmap.model_checks import listed_name, unsupported
from biresnerf.data.formats.parsed_poses import LensOf, ParsedPoses
from biresnerf.data.formats.photogrammetry.views import pose_of_centre
from biresnerf.data.formats.pose_rows import Placed, at_size_of, lens_of_shares, parsed_rows, pose_by
from biresnerf.data.model.atomic_file import write_text
from biresnerf.data.model.refined_set import RefinedSet
from biresnerf.data.model.untrusted_file import (
    Table,
    finite_numbers,
    invalid_file,
    read_table,
    read_text,
    read_xml,
)
from biresnerf.geometry.camera.camera_models import FullParameters
from biresnerf.geometry.rigid import rotation_about
from biresnerf.options.formats import Format

REALITYCAPTURE = Format(
    name="realitycapture",
    title="RealityCapture csv",
    rank=65,
    found_as=("realitycapture.csv", "*.csv"),
    suffixes=(".csv",),
    gives="poses and lenses; with omega, phi, kappa poses only",
    checked_against="its writer; KU-Leuven-Geomatics/geomapi (omega, phi, kappa)",
    axes="opengl",
    in_set="realitycapture.csv",
    loses=("rigs", "points", "mask paths"),
    instead="pinhole",
    lacks="folders of photos; fisheyes; two focal lengths; FULL_OPENCV beyond k3",
    heading="For RealityCapture",
    hint="Internal/External camera parameters, by the photos' file names",
)
REALITYCAPTURE_XMP = Format(
    name="realitycapture-xmp",
    title="RealityCapture XMP",
    rank=66,
    found_as=("images", "."),
    gives="an .xmp beside each photo",
    checked_against="its article on camera maths; KU-Leuven-Geomatics/geomapi",
)
COLUMNS = (
    "name", "x", "y", "alt", "heading", "pitch", "roll", "f", "px", "py", "k1", "k2", "k3", "k4", "t1", "t2",
)  # fmt: skip
_FILM_MM = 36.0
_OPENGL_FROM_OPENCV = np.diag([1.0, -1.0, -1.0])
_HINT = "Export Internal/External camera parameters, with the columns name, x, y, alt, heading, pitch, roll and f."
_NEEDED = COLUMNS[:8]
_WITHOUT_LENS = ("name", "x", "y", "z", "omega", "phi", "kappa")
_XMP_HINT = "Export the XMP again, with poses and Brown3 distortion or none."
_MODELS = ("perspective", "brown3", "brown3t2", "brown4", "brown4t2", "division")
_AS_SQUARE, _NO_SKEW = 1e-6, 1e-6
_begins_so = head_holds(b"capturingreality.com/ns/xcr")
_LENS_KEYS = ("FocalLength35mm", "PrincipalPointU", "PrincipalPointV", "Skew", "AspectRatio")


def parse_realitycapture(_root: Path, file: Path) -> ParsedPoses:
    """The rows of ``file``. Columns other than pose and focal length may be missing; with omega there are no others."""
    titles = {name: (name,) for name in (*COLUMNS, *_WITHOUT_LENS)}
    table = read_table(file.name, read_text(file).splitlines(), titles, lambda found: "name" in found)
    if table is None:
        raise invalid_file(file.name, "has no line that names a column name.", _HINT)
    with_lens = "omega" not in table.columns
    needed = _NEEDED if with_lens else _WITHOUT_LENS
    if missing := [name for name in needed if name not in table.columns]:
        raise invalid_file(table.head, f"has no column {missing[0]}.", _HINT)
    angles = needed[4:7]

    def read(row: list[str], where: str) -> Placed:
        told = [
            name
            for name in table.columns
            if name in needed[1:] or (name in COLUMNS[1:] and table.cell(row, name))
        ]
        value = dict.fromkeys(titles, 0.0) | dict(
            zip(told, table.numbers(row, told, where, _HINT), strict=True)
        )
        a, b, c = (math.radians(value[name]) for name in angles)
        turns = ((2, -a), (0, b), (1, c)) if with_lens else ((1, c), (0, b), (2, -a))
        first, second, third = (rotation_about(axis, angle) for axis, angle in turns)
        rotation, centre = (
            first @ second @ third,
            [value["x"], value["y"], value["alt" if with_lens else "z"]],
        )
        pose = pose_by(REALITYCAPTURE, np.column_stack([rotation, centre]), where)
        if not with_lens:
            return pose, None
        coefficients = [value[name] for name in ("k1", "k2", "k3", "k4", "t1", "t2")]
        return pose, _lens_on_film(value["f"], (value["px"], value["py"]), coefficients, where)

    rows = [(listed_name(table.cell(row, "name"), where), where, row) for where, row in table.rows]
    notes = _perhaps_radians(file.name, table, angles)
    return parsed_rows(REALITYCAPTURE, [file], rows, read, notes=notes)


def _perhaps_radians(file: str, table: Table, angles: Sequence[str]) -> list[str]:
    """A note where no angle of the table exceeds a full turn in radians, although some are not small."""
    with suppress(ValueError):  # rows that cannot be read say so themselves
        largest = max(abs(float(table.cell(row, name))) for _, row in table.rows for name in angles)
        if math.pi / 4 < largest <= 2 * math.pi:
            return [
                f"{file}: no angle is larger than {largest:.3g}. They were read as degrees, as RealityCapture "
                "writes them; if they are radians, multiply them by 180 / pi"
            ]
    return []


def _lens_on_film(
    focal_mm: float, centre: tuple[float, float], coefficients: Sequence[float], where: str
) -> LensOf:
    """The lens at each image's size, from k1 to k4, and OpenCV's p1 and p2.

    Raises:
        InputError: ``camera_model_unsupported`` for a fourth radial coefficient.
    """
    k1, k2, k3, k4, p1, p2 = coefficients
    if k4:
        raise unsupported(
            where,
            "k4 is not zero, and no supported camera model has it.",
            "Set the distortion model to Brown3 and export again, or export undistorted images.",
        )
    focal = focal_mm / _FILM_MM
    lens = FullParameters(focal, focal, *centre, k1=k1, k2=k2, k3=k3, p1=p1, p2=p2)
    return at_size_of(lens_of_shares(lens, where))


def write_realitycapture(refined: RefinedSet, path: Path) -> None:
    """Writes the file, whole or not at all; a line an image, in the set's order.

    Raises:
        InputError: ``export_not_possible``: a lens that the file cannot hold, or two photos of one file name.
    """
    LensLimits("RealityCapture", fisheye=None, two_focal_lengths=False).refuse(refined.cameras, path.name)
    names = [PurePosixPath(image.file_name).name for image in refined.images]
    if len(set(names)) < len(names):
        raise cannot_hold(
            path.name,
            "RealityCapture's csv names photos by their file names, which two photos of this set share.",
            "Export `pinhole`, whose photos have names of their own, and convert that.",
        )
    file = io.StringIO()
    table = csv.writer(file, lineterminator="\n")
    table.writerow((f"#{COLUMNS[0]}", *COLUMNS[1:]))
    for index, (name, pose) in enumerate(zip(names, refined.world_from_cam, strict=True)):
        camera = refined.camera_of(index)
        full, size = camera.full(), max(camera.width, camera.height)
        heading, pitch, roll = _angles_deg(pose[:3, :3] @ _OPENGL_FROM_OPENCV)
        centre = ((full.cx - camera.width / 2) / size, (full.cy - camera.height / 2) / size)
        lens = (full.fx * _FILM_MM / size, *centre, full.k1, full.k2, full.k3, 0.0, full.p1, full.p2)
        table.writerow([name, *pose[:3, 3].tolist(), heading, pitch, roll, *lens])
    write_text(path, file.getvalue().rstrip("\n"))


def _angles_deg(rotation: NDArray[np.float64]) -> tuple[float, float, float]:
    """Heading, pitch and roll of ``rotation`` = Rz(-heading) Rx(pitch) Ry(roll), degrees; roll is 0 at the poles."""
    sine = float(np.clip(rotation[2, 1], -1.0, 1.0))
    across = math.hypot(rotation[2, 0], rotation[2, 2])
    pitch = math.atan2(sine, across)
    if across > 1e-9:
        yaw, roll = (
            math.atan2(-rotation[0, 1], rotation[1, 1]),
            math.atan2(-rotation[2, 0], rotation[2, 2]),
        )
    else:
        yaw, roll = math.atan2(rotation[1, 0], rotation[0, 0]), 0.0
    return math.degrees(-yaw), math.degrees(pitch), math.degrees(roll)


def parse_realitycapture_xmp(_root: Path, place: Path) -> ParsedPoses:
    """The poses of the XMP files in ``place``; photos without one, or whose file has only a lens, have none.

    Raises:
        InputError: codes as in docs/input.md.
    """
    files = [path for path in sorted(place.glob("*.xmp")) if _begins_so(path)]
    rows = [(f"{path.stem}.jpg", path.name, path) for path in files]
    return parsed_rows(REALITYCAPTURE_XMP, files, rows, _read_xmp, take_file_names=True)


def _read_xmp(file: Path, where: str) -> Placed:
    values = {}
    for element in read_xml(file, _XMP_HINT).iter():
        for key, text in [*element.attrib.items(), (element.tag, element.text or "")]:
            if "capturingreality.com/ns/xcr" in key and text.strip():
                values[key.rpartition("}")[2]] = text

    def numbers(key: str, count: int) -> list[float]:
        found: list[float] = finite_numbers(
            values[key].split(), f"{where} xcr:{key}", _XMP_HINT, count
        ).tolist()
        return found

    lens = _xmp_lens(values, {key: numbers(key, 1)[0] for key in _LENS_KEYS if key in values}, numbers, where)
    if "Position" not in values or "Rotation" not in values:
        return None, lens
    rotation = np.array(numbers("Rotation", 9)).reshape(3, 3)
    return pose_of_centre(rotation.T, numbers("Position", 3), f"{where} xcr:Rotation"), lens


def _xmp_lens(
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
        raise unsupported(where, f"{problem} is not supported.", _XMP_HINT)
    centre = given.get("PrincipalPointU", 0.0), given.get("PrincipalPointV", 0.0)
    return _lens_on_film(given["FocalLength35mm"], centre, (k1, k2, k3, k4, t2, t1), where)


def _has_xmp(place: Path) -> bool:
    return place.is_dir() and any(_begins_so(path) for path in sorted(place.glob("*.xmp")))


CODECS = (
    Codec(
        REALITYCAPTURE,
        parse=parse_realitycapture,
        recognises=lambda file: (
            head_holds(b"#name,", b"#name;", b"#name\t")(file)
            and (head_holds(b"heading")(file) or head_holds(b"omega,phi,kappa")(file))
        ),
        write=lambda refined, path, _: write_realitycapture(refined, path),
        given_back=lambda dataset: dataset.source.dialect == "realitycapture",
    ),
    Codec(
        REALITYCAPTURE_XMP,
        parse=parse_realitycapture_xmp,
        recognises=_has_xmp,
        pose_place=lambda file: file.parent if file.suffix.lower() == ".xmp" else None,
        image_root=lambda place: place.parent if place.name == "images" else place,
    ),
)
