"""The lines of a trajectory file: poses, times and the names of images; a bad line costs one pose, not the file."""

from __future__ import annotations

import re
from collections import Counter
from dataclasses import replace
from functools import partial
from pathlib import Path

from biresnerf.data.formats.colmap.model_checks import rigid_pose
from biresnerf.data.formats.pose_rows import MAX_ROWS, Placed, entry_of
from biresnerf.data.formats.simple.times_of_images import number_of
from biresnerf.data.model.colmap_scene import matrix_of_pose
from biresnerf.data.model.pose_validation import rigid_matrix
from biresnerf.data.model.untrusted_file import finite_numbers, read_text
from biresnerf.errors import InputError

IMAGES_OF = "{stem}_images.txt"  # beside our KITTI files, which have no room for names: an image a line
_HINT = "Give lines of `time x y z qx qy qz qw` (TUM; without times, as many as images), or [R | t] by rows (KITTI)."
_COLUMNS: dict[int, str] = {7: "tum", 8: "tum", 12: "kitti"}
# What `refine` writes above its poses: which image was taken when.
_NAMED_TIME = re.compile(r"#\s*([-+0-9.eE]+)\s+(\S.*\S|\S)\s*$")


class Trajectory:
    """Poses in the file's order, called by their images, times or numbers; bad ones of a file without times included.

    ``times_s`` and the names of images by time are there where the file has them; ``left_out`` are bad lines, which
    are no pose as they have a time or another number of words.
    """

    def __init__(self, file: Path) -> None:
        self.file = file
        self.times_s: list[float] = []
        self.name_of_time: dict[float, str] = {}
        rows: list[tuple[str, list[str]]] = []
        for number, line in enumerate(read_text(file).splitlines(), start=1):
            words = line.replace(",", " ").split()
            if not words or line.lstrip().startswith("#"):
                self._note_name(line)
            elif rows or not all(number_of(word) is None for word in words):  # else a header without its mark
                rows.append((f"{file.name} line {number}", words))
            if len(rows) > MAX_ROWS:
                raise _invalid(f"{file.name} line {number}", f"more than {MAX_ROWS} poses are not read.")
        lengths = Counter(len(words) for _, words in rows if len(words) in _COLUMNS)
        columns = lengths.most_common(1)[0][0] if lengths else 0
        read = [entry_of(where, where, partial(_read, words, columns, where)) for where, words in rows]
        timed = columns == 8
        entries = [entry for entry in read if not timed or entry.problem is None]
        self.left_out = [entry for entry in read if timed and entry.problem is not None]
        if not any(entry.problem is None for entry in entries):
            raise next((one.problem for one in read if one.problem), _invalid(file.name, "holds no pose."))
        if timed:
            words_at = dict(rows)
            self.times_s = [float(words_at[entry.where][0]) for entry in entries]
        self.dialect = _COLUMNS[columns]
        self.image_names = [self.name_of_time.get(time, "") for time in self.times_s]
        list_file = file.with_name(IMAGES_OF.format(stem=file.stem))
        self.files = [file]
        if not self.times_s and list_file.is_file():
            self.files.append(list_file)
            self.image_names = read_text(list_file).splitlines()
            if len(self.image_names) != len(entries):
                raise _invalid(
                    list_file.name, f"names {len(self.image_names)} images for {len(entries)} poses."
                )
        if len(set(self.times_s)) != len(self.times_s):
            raise _invalid(file.name, "two poses have the same time.")
        called = self.image_names or [""] * len(entries)
        others = [f"{time:.17g}" for time in self.times_s] or [str(index) for index in range(len(entries))]
        self.entries = [
            replace(entry, name=name or other)
            for entry, name, other in zip(entries, called, others, strict=True)
        ]

    def _note_name(self, line: str) -> None:
        match = _NAMED_TIME.match(line.strip())
        time = number_of(match[1]) if match else None
        if match and time is not None:
            self.name_of_time[time] = match[2]


def _read(words: list[str], columns: int, where: str) -> Placed:
    if len(words) not in _COLUMNS or len(words) != columns:
        raise _invalid(where, f"has {len(words)} numbers, not 8 or 7 (TUM) or 12 (KITTI) as every line.")
    values = finite_numbers(words, where, _HINT)
    if columns == 12:
        return rigid_matrix(values.reshape(3, 4).tolist(), where)[0], None
    x, y, z, a, b, c, w = values[-7:].tolist()
    return matrix_of_pose(rigid_pose([w, a, b, c, x, y, z], where, _HINT)), None


def _invalid(where: str, what: str, code: str = "pose_file_invalid") -> InputError:
    return InputError(code, what, where=where, hint=_HINT)
