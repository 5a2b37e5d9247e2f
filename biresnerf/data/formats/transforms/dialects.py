"""Dialects of transforms.json, converted to nerfstudio's keys; keys of unknown meaning are refused.

- NeuS2 (src/nerf_loader.cu and nerf_loader.h of 19reborn/NeuS2): ``from_na`` means OpenCV axes, and
  ``intrinsic_matrix`` of a frame is its lens, unless a focal length is given.
- instant-ngp's loader: ``normal_mts_args`` means Mitsuba's axes (x left, y up), ``transform_matrix_start`` stands for
  ``transform_matrix``.
- ``ns-export cameras`` of nerfstudio: lists of ``file_path`` and ``transform``, of training and of evaluation, without
  lenses, with paths from the folder that it ran in.
"""

from __future__ import annotations

import re
from contextlib import suppress
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from numpy.typing import NDArray

from biresnerf.data.formats.transforms.write_intrinsics import FOCAL_KEYS
from biresnerf.data.model.untrusted_file import invalid_file, read_json
from biresnerf.errors import InputError

_HINT = "Give a transforms.json as nerfstudio, instant-ngp or Blender write it."
_EVALUATED = {"transforms_train.json": "transforms_eval.json"}  # what ns-export writes
# Keys of other axes of cameras, and what they are to OpenGL's.
_AXES = {"from_na": (1.0, -1.0, -1.0, 1.0), "normal_mts_args": (-1.0, 1.0, -1.0, 1.0)}
_LENSES = ("intrinsic_matrix", "intrinsics", "intrinsic", "camera_intrinsics", "camera_matrix", "K")
_POSES = re.compile(
    r"pose|extrinsic|c2w|w2c|cam(era)?_?(2|to)_?world|world_?(2|to)_?cam|transform|matrix", re.I
)
_CONVENTION = re.compile(r"axes|convention|coord|handed|opencv|opengl|w2c|world_?(2|to)_?cam|from_", re.I)
_OTHER = re.compile(r"true|opencv|colmap|rdf|w2c|world_?(2|to)_?cam|left|unity|unreal", re.I)
_DISTORTION = re.compile(r"dist(ortion)?(_?(params|coeff\w*|vector))?$", re.I)
_LEAST_SKEW_PX = 0.5


def plain_document(path: Path) -> tuple[dict[str, Any], list[str]]:
    """The document of the file with nerfstudio's keys, and notes on what was converted.

    Raises:
        InputError: a code of `read_json`, ``pose_file_invalid`` or ``intrinsics_invalid``.
    """
    document = read_json(path, apart="frames")
    notes: list[str] = []
    if isinstance(document, list):
        document, notes = _exported(document, path)
    if not isinstance(document, dict):
        raise invalid_file(
            path.name, f"holds a {type(document).__name__}, not an object with `frames`.", _HINT
        )
    frames = document.get("frames")
    rows = [row for row in frames if isinstance(row, dict)] if isinstance(frames, list) else []
    for row in rows:
        if row.get("transform_matrix") is None and row.get("transform_matrix_start") is not None:
            row["transform_matrix"] = row.pop("transform_matrix_start")
            row.pop("transform_matrix_end", None)
    _refuse_other_meanings(document, rows, path.name)
    key = next((key for key in _AXES if document.get(key)), None)
    if key is not None:
        notes.append(f"{key}: the file's cameras have other axes than OpenGL's, which the result's have")
        document = {name: value for name, value in document.items() if name not in _AXES}
        for row in rows:
            if (matrix := _matrix(row.get("transform_matrix"))) is not None:
                row["transform_matrix"] = (matrix * _AXES[key]).tolist()
    if not _has_focal(document):
        for index, place in enumerate([document, *rows]):
            _put_matrix_into_keys(place, f"{path.name} frames[{index - 1}]." if index else f"{path.name} ")
    return document, notes


def _exported(document: list[Any], path: Path) -> tuple[dict[str, Any], list[str]]:
    """The cameras of ns-export as frames, those of evaluation included."""
    beside, rows = path.with_name(_EVALUATED.get(path.name, path.name)), list(document)
    if beside != path and beside.is_file():
        with suppress(InputError):
            more = read_json(beside)
            rows += more if isinstance(more, list) else []
    if not rows or not all(isinstance(row, dict) and "transform" in row for row in rows):
        raise invalid_file(path.name, "is a list, but not of cameras with file_path and transform.", _HINT)
    frames = [
        {"file_path": _shortened(row.get("file_path"), path.parent), "transform_matrix": row["transform"]}
        for row in rows
    ]
    note = "are cameras as `ns-export cameras` writes them: in the world that nerfstudio trained in, without lenses"
    files = path.name if len(rows) == len(document) else f"{path.name} and {beside.name}"
    return {"camera_model": "OPENCV", "frames": frames}, [f"{files} {note}"]


def _shortened(name: object, folder: Path) -> object:
    """The end of a path that leads to a file from ``folder``; the path where none does."""
    parts = PurePosixPath(name.replace("\\", "/")).parts if isinstance(name, str) else ()
    ends = ("/".join(parts[start:]) for start in range(len(parts)))
    return next((end for end in ends if not end.startswith("/") and (folder / end).is_file()), name)


def _matrix(value: object) -> NDArray[np.float64] | None:
    """A matrix [3 or 4, 4] of numbers, or None."""
    with suppress(TypeError, ValueError):
        matrix = np.array(value, dtype=np.float64)
        if matrix.shape in ((3, 4), (4, 4)):
            return matrix
    return None


def _has_focal(place: dict[str, Any]) -> bool:
    return any(place.get(key) is not None for key in FOCAL_KEYS)


def _put_matrix_into_keys(place: dict[str, Any], where: str) -> None:
    """Replaces an intrinsic matrix of a frame, or of the file, by keys, unless a focal length is given.

    The same for the four numbers fx, fy, cx, cy: in a list, or under these names.
    """
    for short, key in (("fx", "fl_x"), ("fy", "fl_y")) if not _has_focal(place) else ():
        if place.get(short) is not None:
            place[key] = place.pop(short)
    for key in _LENSES if not _has_focal(place) else ():
        with suppress(TypeError, ValueError):
            value = place.get(key)
            value = (
                [value.get(name) for name in ("fx", "fy", "cx", "cy")] if isinstance(value, dict) else value
            )
            matrix = np.array(value, dtype=np.float64)
            matrix = matrix.reshape(3, 3) if matrix.shape == (9,) else matrix
            if matrix.shape == (4,):
                fx, fy, cx, cy = matrix
                matrix = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
            if matrix.shape not in ((3, 3), (3, 4), (4, 4)) or not np.isfinite(matrix).all():
                continue
            fx, skew, cx, fy, cy = (float(matrix[at]) for at in ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2)))
            if abs(skew * cy) > _LEAST_SKEW_PX * abs(fy):
                raise InputError(
                    "intrinsics_invalid",
                    f"a skew of {skew:.3g} px, which a transforms.json cannot hold.",
                    where=f"{where}{key}",
                    hint="Straighten the photos, and give fl_x, fl_y, cx and cy.",
                )
            del place[key]
            place |= {"fl_x": fx, "fl_y": fy, "cx": cx, "cy": cy}
            return


def _refuse_other_meanings(document: dict[str, Any], rows: list[dict[str, Any]], file: str) -> None:
    """Raises InputError for keys that are not read and would change what the poses or lenses mean."""
    for key, value in document.items():
        other = isinstance(value, bool | str) and _OTHER.search(str(value))
        if key not in _AXES and _CONVENTION.search(key) and other:
            raise invalid_file(
                f"{file} {key}",
                f"is {str(value)[:40]!r}, and poses are read as camera to world with OpenGL axes.",
                "Convert the matrices to these and remove the key; or remove it if they are so already.",
            )
    for place in (document, *rows[:1]):
        for key, value in place.items():
            if _DISTORTION.match(key) and isinstance(value, list) and any(value):
                raise InputError(
                    "intrinsics_invalid",
                    "is a list of coefficients, whose order files do not agree on.",
                    where=f"{file} {key}",
                    hint="Give k1, k2, p1, p2 and k3 as keys of their own, by OpenCV's names.",
                )
    if rows and not any("transform_matrix" in row for row in rows):
        named = [key for key, value in rows[0].items() if _POSES.search(key) and _matrix(value) is not None]
        if named := [key for key in named if key not in _LENSES]:
            raise invalid_file(
                f"{file} frames[0].{named[0]}",
                "is a matrix under a key that is not read.",
                "Give camera to world with OpenGL axes as transform_matrix.",
            )
