"""EuRoC's ground truth: a csv of the body's poses, and cam0/sensor.yaml, which says how the camera sits on the body.

ASL's layout (projects.asl.ethz.ch, kmavvisualinertialdatasets, and the head of the csv itself): ns, position and
quaternion, scalar first, of world_from_body; ``T_BS`` is body_from_cam by rows. OpenCV axes and lenses; a pixel's
coordinates are its indices, as in the calibration by Kalibr. Photos are called by their time in ns.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path, PurePosixPath

import numpy as np
from numpy.typing import NDArray

from biresnerf.data.formats.codec import Codec, head_holds
from biresnerf.data.formats.colmap.model_checks import unsupported
from biresnerf.data.formats.parsed_poses import Assignment, ParsedPoses, PoseEntry
from biresnerf.data.formats.pose_rows import Placed, Row, lens_of, parsed_rows, pose_of_numbers
from biresnerf.data.formats.simple.times_of_images import MAX_TIME_APART_S, nearest_poses
from biresnerf.data.model.pose_validation import rigid_matrix
from biresnerf.data.model.untrusted_file import finite_numbers, invalid_file, read_text
from biresnerf.errors import InputError
from biresnerf.geometry.camera.camera_models import Camera, FullParameters
from biresnerf.options.formats import Format

EUROC = Format(
    name="euroc",
    title="EuRoC",
    rank=93,
    found_as=(
        "state_groundtruth_estimate0/data.csv",
        "mav0/state_groundtruth_estimate0/data.csv",
    ),
    suffixes=(".csv",),
    gives="poses of cam0, its times and lens",
    checked_against="its description; MichaelGrupp/evo",
)
_HINT = (
    "Give mav0/ as the dataset has it: state_groundtruth_estimate0/data.csv, cam0/sensor.yaml and cam0/data/."
)
_NS = 1e-9
_COLUMNS = 8  # of the time and the pose; velocities and biases follow


def parse_euroc(root: Path, file: Path) -> ParsedPoses:
    """The poses of cam0 at the times of the body's; each photo takes the nearest within 0.02 s."""
    sensor = file.parent.parent / "cam0" / "sensor.yaml"
    body_from_cam, lens = _read_sensor(sensor)

    def read(words: list[str], where: str) -> Placed:
        if len(words) < _COLUMNS:
            raise invalid_file(
                where, f"has {len(words)} values, not a time, a position and a quaternion.", _HINT
            )
        x, y, z, *quat_wxyz = finite_numbers(words[1:_COLUMNS], where, _HINT).tolist()
        return pose_of_numbers(EUROC, quat_wxyz, (x, y, z), where, _HINT) @ body_from_cam, lens

    rows: list[Row] = []
    for number, line in enumerate(read_text(file).splitlines(), start=1):
        words = [word.strip() for word in line.split(",")]
        if words[0] and not words[0].startswith("#"):
            rows.append((words[0], f"{file.name} line {number}", words))
    photos = sensor.parent / "data"
    folder = photos.relative_to(root).as_posix() if photos.is_relative_to(root) else "data"
    parsed = parsed_rows(EUROC, [file, sensor], rows, read, photo_folders=(folder,))
    times = [_seconds(entry.name, entry.where) for entry in parsed.entries]
    timed = tuple(replace(entry, timestamp_s=time) for entry, time in zip(parsed.entries, times, strict=True))
    return replace(parsed, entries=timed, assign=partial(_by_time, timed, file, lens), named=False)


def _seconds(word: str, where: str) -> float:
    if not word.isdecimal() or len(word) > 19:
        raise invalid_file(where, "does not begin with a time in whole ns.", _HINT)
    return int(word) * _NS


def _by_time(entries: tuple[PoseEntry, ...], file: Path, lens: Camera, names: Sequence[str]) -> Assignment:
    """Each photo with the pose nearest to its time, or with none."""
    stems = {name: PurePosixPath(name).stem for name in names}
    taken = {name: int(stem) * _NS for name, stem in stems.items() if stem.isdecimal() and len(stem) <= 19}
    times = [0.0 if entry.timestamp_s is None else entry.timestamp_s for entry in entries]
    found = nearest_poses(taken, times)
    if not found:
        detail = f"no pose is within {MAX_TIME_APART_S} s of a photo, whose names must be times in ns."
        raise InputError("pose_count_mismatch", detail, where=file.name, hint=_HINT)
    pairs = [
        (name, replace(entries[found[name]], name=name, timestamp_s=taken[name]))
        if name in found
        else (name, PoseEntry(name, None, file.name, lens, timestamp_s=taken.get(name)))
        for name in names
    ]
    return pairs, [f"{file.name}: poses were matched by time, at most {MAX_TIME_APART_S} s apart"]


def _read_sensor(file: Path) -> tuple[NDArray[np.float64], Camera]:
    """``body_from_cam`` [4, 4] and the lens."""
    if not file.is_file():
        what = "is not there: it says how the camera sits on the body whose poses these are."
        raise invalid_file(f"cam0/{file.name}", what, _HINT)
    text = re.sub(r"#[^\n]*", "", read_text(file))

    def numbers(key: str, count: int) -> list[float]:
        match = re.search(rf"\b{key}:[^\[\]]{{0,200}}\[([^\]]{{0,2000}})\]", text)
        words = match[1].replace(",", " ").split() if match else []
        found: list[float] = finite_numbers(words, f"cam0/{file.name} {key}", _HINT, count).tolist()
        return found

    matrix = np.reshape(numbers("T_BS", 16), (4, 4)).tolist()  # cols and rows stand between
    body_from_cam = rigid_matrix(matrix, f"cam0/{file.name} T_BS")[0]
    fx, fy, cx, cy = numbers("intrinsics", 4)
    a, b, c, d = numbers("distortion_coefficients", 4)
    width, height = numbers("resolution", 2)
    model = re.search(r"^[ \t]*distortion_model:[ \t]*(\S+)", text, re.MULTILINE)
    kind, centre = model[1] if model else "", (cx + 0.5, cy + 0.5)
    if kind in ("equidistant", "fisheye"):
        full = FullParameters(fx, fy, *centre, k1=a, k2=b, k3=c, k4=d, fisheye=True)
    elif kind in ("radial-tangential", "radtan"):
        full = FullParameters(fx, fy, *centre, k1=a, k2=b, p1=c, p2=d)
    else:
        raise unsupported(
            f"cam0/{file.name} distortion_model",
            f"the distortion model {kind[:40]!r} is not supported.",
            "Supported are radial-tangential and equidistant.",
        )
    return body_from_cam, lens_of(full, f"cam0/{file.name}", (int(width), int(height)))


CODECS = (
    Codec(
        EUROC,
        parse=parse_euroc,
        recognises=head_holds(b"p_RS_R"),
        image_root=lambda place: place.parent.parent,
    ),
)
