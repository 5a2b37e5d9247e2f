"""RealEstate10K's cameras: a line a frame of 19 numbers, below the video's address.

Time in microseconds, fx, fy, cx, cy as shares of the width and height, two zeros, and cam_from_world [3, 4] by rows,
OpenCV axes: google.github.io/realestate10k. Photos are called by their times, or are as many as the lines.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path, PurePosixPath

import numpy as np

from biresnerf.data.formats.bind_images import in_order
from biresnerf.data.formats.codec import Codec
from biresnerf.data.formats.parsed_poses import Assignment, ParsedPoses
from biresnerf.data.formats.pose_rows import Placed, Row, at_size_of, lens_of, parsed_rows
from biresnerf.data.model.pose_validation import rigid_matrix
from biresnerf.data.model.untrusted_file import finite_numbers, invalid_file, read_text
from biresnerf.geometry.camera.camera_models import Camera, FullParameters
from biresnerf.geometry.rigid import rigid_inverse
from biresnerf.options.formats import Format

REALESTATE10K = Format(
    name="realestate10k",
    title="RealEstate10K",
    rank=95,
    found_as=("*.txt",),
    suffixes=(".txt",),
    gives="poses and lenses",
    checked_against="its description",
    cam_from_world=True,
)
_HINT = "Give lines of 19 numbers: time, fx, fy, cx, cy, 0, 0, and [R | t] of world to camera by rows."
_COLUMNS = 19


def parse_realestate10k(_root: Path, file: Path) -> ParsedPoses:
    """The cameras of ``file``, called by their times.

    Raises:
        InputError: codes as in docs/input.md.
    """
    lines = [(number, line.split()) for number, line in enumerate(read_text(file).splitlines(), start=1)]
    rows: list[Row] = [
        (words[0], f"{file.name} line {number}", partial(_read, words, f"{file.name} line {number}"))
        for number, words in lines
        if words and not words[0].startswith(("http", "#"))
    ]
    parsed = parsed_rows("realestate10k", [file], rows)
    by_time = {entry.name: entry for entry in parsed.entries}

    def assign(names: Sequence[str]) -> Assignment:
        timed = [name for name in names if PurePosixPath(name).stem in by_time]
        if 2 * len(timed) <= len(names):
            return in_order(parsed.entries, names, file.name, "Call the photos by the times of their frames.")
        return [(name, replace(by_time[PurePosixPath(name).stem], name=name)) for name in timed], []

    return replace(parsed, assign=assign, named=False, photo_folders=("frames",))


def _read(words: Sequence[str], where: str) -> Placed:
    if len(words) != _COLUMNS:
        raise invalid_file(where, f"has {len(words)} numbers, not {_COLUMNS}.", _HINT)
    _, fx, fy, cx, cy, k1, k2, *matrix = finite_numbers(words, where, _HINT).tolist()
    pose = rigid_inverse(rigid_matrix(np.reshape(matrix, (3, 4)).tolist(), where)[0])

    def lens(width: int, height: int) -> Camera:
        full = FullParameters(fx * width, fy * height, cx * width, cy * height, k1=k1, k2=k2)
        return lens_of(full, where, (width, height))

    return pose, at_size_of(lens)


def _recognises(file: Path) -> bool:
    if not file.is_file():
        return False
    with file.open("rb") as opened:
        lines = [opened.readline(4096).split() for _ in range(2)]
    words = lines[1] if lines[0][:1] and lines[0][0].startswith(b"http") else lines[0]
    return len(words) == _COLUMNS and all(word.strip(b"-+.eE0123456789") == b"" for word in words)


CODECS = (Codec(REALESTATE10K, parse=parse_realestate10k, recognises=_recognises),)
