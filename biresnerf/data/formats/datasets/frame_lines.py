"""Text files with a line, or a few, for each image: RealEstate10K, and the .log of Tanks and Temples.

RealEstate10K has a line a frame of 19 numbers, below the video's address: time in microseconds, fx, fy, cx, cy as
shares of the width and height, two zeros, and [3, 4] by rows: google.github.io/realestate10k. Photos are called by
their times, or are as many as the lines.

The ``.log``, which Open3D writes as well, has five lines an image, in the order of their names: two numbers and an
error, then a matrix; the second number is -1, and the matrix means nothing, for an image without a pose:
python_toolbox/convert_to_logfile.py of isl-org/TanksAndTemples.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path, PurePosixPath
from typing import TypeAlias

import numpy as np

from biresnerf.data.formats.bind_images import in_order
from biresnerf.data.formats.codec import Codec, head_matches
from biresnerf.data.formats.parsed_poses import Assignment, ParsedPoses
from biresnerf.data.formats.pose_rows import Placed, at_size_of, lens_of, parsed_rows, pose_by
from biresnerf.data.model.untrusted_file import finite_numbers, invalid_file, read_words
from biresnerf.geometry.camera.camera_models import Camera, FullParameters
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
TANKS_AND_TEMPLES = Format(
    name="tanks-and-temples",
    title="Tanks and Temples .log",
    rank=88,
    found_as=("*.log",),
    suffixes=(".log",),
    gives="poses",
    checked_against="its converter; isl-org/TanksAndTemples",
)
_Words: TypeAlias = list[str]
_LINE = rb"(http[^\n]*\n)?[ \t]*([-+.eE0-9]+[ \t]+){18}[-+.eE0-9]+[ \t]*(\r?\n|\Z)"
_LINE_HINT = "Give lines of 19 numbers: time, fx, fy, cx, cy, 0, 0, and [R | t] of world to camera by rows."
_BLOCK = rb"(?i)\s*\d+\s+-?\d+\s+\S+[ \t]*\r?\n\s*([-+]?[\d.]+(e[-+]?\d+)?\s+){4}"
_BLOCK_HINT = "Give five lines an image: two numbers and an error, then 4 rows of 4 numbers, camera to world."


def parse_realestate10k(_root: Path, file: Path) -> ParsedPoses:
    """The cameras of ``file``, called by their times."""
    lines = read_words(file)
    rows = [(words[0], where, words) for where, words in lines if not words[0].startswith("http")]
    parsed = parsed_rows(REALESTATE10K, [file], rows, _read_line, photo_folders=("frames",))
    by_time = {entry.name: entry for entry in parsed.entries}

    def assign(names: Sequence[str]) -> Assignment:
        timed = [name for name in names if PurePosixPath(name).stem in by_time]
        if 2 * len(timed) <= len(names):
            return in_order(parsed.entries, names, file.name, "Call the photos by the times of their frames.")
        return [(name, replace(by_time[PurePosixPath(name).stem], name=name)) for name in timed], []

    return replace(parsed, assign=assign, named=False)


def _read_line(words: _Words, where: str) -> Placed:
    _, fx, fy, cx, cy, k1, k2, *matrix = finite_numbers(words, where, _LINE_HINT, 19).tolist()

    def lens(width: int, height: int) -> Camera:
        full = FullParameters(fx * width, fy * height, cx * width, cy * height, k1=k1, k2=k2)
        return lens_of(full, where, (width, height))

    return pose_by(REALESTATE10K, np.reshape(matrix, (3, 4)), where), at_size_of(lens)


def parse_tanks_and_temples(_root: Path, file: Path) -> ParsedPoses:
    """The matrices of ``file``, for the images in the order of their names.

    Raises:
        InputError: codes as in docs/input.md.
    """
    lines = read_words(file)
    if len(lines) % 5:
        raise invalid_file(file.name, f"has {len(lines)} lines, not five an image.", _BLOCK_HINT)
    rows = [
        (str(at // 5), lines[at][0], [words for _, words in lines[at : at + 5]])
        for at in range(0, len(lines), 5)
    ]
    return parsed_rows(TANKS_AND_TEMPLES, [file], rows, _read_block, in_order_of_names="natural")


def _read_block(block: list[_Words], where: str) -> Placed:
    head, *rows = block
    if len(head) != 3 or [len(row) for row in rows] != [4] * 4:
        raise invalid_file(where, "is not a line of three numbers and four of four.", _BLOCK_HINT)
    numbers = finite_numbers(head, where, _BLOCK_HINT)
    matrix = finite_numbers([word for row in rows for word in row], where, _BLOCK_HINT).reshape(4, 4)
    return (None if numbers[1] < 0 else pose_by(TANKS_AND_TEMPLES, matrix, where)), None


CODECS = (
    Codec(REALESTATE10K, parse=parse_realestate10k, recognises=head_matches(_LINE)),
    Codec(TANKS_AND_TEMPLES, parse=parse_tanks_and_temples, recognises=head_matches(_BLOCK)),
)
