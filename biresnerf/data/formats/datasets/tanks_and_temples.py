"""The ``.log`` of Tanks and Temples, which Open3D writes as well: a matrix an image, in the order of their names.

Five lines an image: two numbers and an error, then camera to world, OpenCV axes; the second number is -1, and the
matrix means nothing, for an image without a pose: python_toolbox/convert_to_logfile.py of isl-org/TanksAndTemples.
"""

from __future__ import annotations

import re
from dataclasses import replace
from functools import partial
from pathlib import Path

from biresnerf.data.formats.bind_images import in_order
from biresnerf.data.formats.codec import Codec
from biresnerf.data.formats.parsed_poses import ParsedPoses
from biresnerf.data.formats.pose_rows import Placed, Row, parsed_rows
from biresnerf.data.model.pose_validation import rigid_matrix
from biresnerf.data.model.untrusted_file import finite_numbers, invalid_file, read_text
from biresnerf.options.formats import Format

TANKS_AND_TEMPLES = Format(
    name="tanks-and-temples",
    title="Tanks and Temples .log",
    rank=88,
    found_as=("*.log",),
    suffixes=(".log",),
    gives="poses",
    checked_against="its converter; isl-org/TanksAndTemples",
)
_HINT = "Give five lines an image: its number, the number in the reconstruction and an error; then 4 rows of 4 numbers."
_BEGINS = re.compile(rb"\s*\d+\s+-?\d+\s+\S+[ \t]*\r?\n\s*([-+]?[\d.]+(e[-+]?\d+)?\s+){4}", re.IGNORECASE)
_HEAD_BYTES = 4096


def parse_tanks_and_temples(_root: Path, file: Path) -> ParsedPoses:
    """The matrices of ``file``, for the images in the order of their names.

    Raises:
        InputError: codes as in docs/input.md.
    """
    lines = [
        (number, line.split()) for number, line in enumerate(read_text(file).splitlines(), 1) if line.strip()
    ]
    if len(lines) % 5:
        raise invalid_file(file.name, f"has {len(lines)} lines, not five an image.", _HINT)
    rows: list[Row] = []
    for index in range(len(lines) // 5):
        block = lines[5 * index : 5 * index + 5]
        where = f"{file.name} line {block[0][0]}"
        rows.append((str(index), where, partial(_read, [words for _, words in block], where)))
    parsed = parsed_rows("tanks-and-temples", [file], rows)
    hint = "Leave in images/ just the images that the poses are for; their order by name decides."
    assign = partial(in_order, parsed.entries, file=file.name, hint=hint)
    return replace(parsed, assign=assign, named=False)


def _read(block: list[list[str]], where: str) -> Placed:
    head, *rows = block
    if len(head) != 3 or [len(row) for row in rows] != [4] * 4:
        raise invalid_file(where, "is not a line of three numbers and four of four.", _HINT)
    numbers = finite_numbers(head, where, _HINT)
    matrix = finite_numbers([word for row in rows for word in row], where, _HINT).reshape(4, 4)
    return (None if numbers[1] < 0 else rigid_matrix(matrix.tolist(), where)[0]), None


def _recognises(file: Path) -> bool:
    if not file.is_file():
        return False
    with file.open("rb") as opened:
        return _BEGINS.match(opened.read(_HEAD_BYTES)) is not None


CODECS = (Codec(TANKS_AND_TEMPLES, parse=parse_tanks_and_temples, recognises=_recognises),)
