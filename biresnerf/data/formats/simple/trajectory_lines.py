"""The lines of a trajectory file: poses, times and the names of images; a bad line costs one pose, not the file."""

from __future__ import annotations

import re
from collections import Counter
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from biresnerf.data.formats.bad_frames import attempt
from biresnerf.data.formats.colmap.model_checks import rigid_pose
from biresnerf.data.formats.parsed_poses import PoseEntry
from biresnerf.data.formats.simple.times_of_images import number_of
from biresnerf.data.model.colmap_scene import matrix_of_pose
from biresnerf.data.model.pose_validation import rigid_matrix
from biresnerf.data.model.untrusted_file import finite_numbers, read_text
from biresnerf.errors import InputError

IMAGES_OF = "{stem}_images.txt"  # beside our KITTI files, which have no room for names: an image a line
MAX_POSES = 100_000
_HINT = "Give lines of `time x y z qx qy qz qw` (TUM; without times, as many as images), or [R | t] by rows (KITTI)."
_COLUMNS: dict[int, str] = {7: "tum", 8: "tum", 12: "kitti"}
# What `refine` writes above its poses: which image was taken when.
_NAMED_TIME = re.compile(r"#\s*([-+0-9.eE]+)\s+(\S.*\S|\S)\s*$")


class Trajectory:
    """Poses in the file's order; ``times_s`` and the names of images by time where the file has them.

    ``problems`` has the bad ones among the poses, by index; ``left_out`` the bad lines that are no pose.
    """

    def __init__(self, file: Path) -> None:
        self.file = file
        self.poses: list[NDArray[np.float64]] = []
        self.times_s: list[float] = []
        self.lines: list[int] = []
        self.name_of_time: dict[float, str] = {}
        self.left_out: list[PoseEntry] = []
        self.problems: dict[int, PoseEntry] = {}
        rows: list[tuple[int, list[str]]] = []
        for number, line in enumerate(read_text(file).splitlines(), start=1):
            words = line.replace(",", " ").split()
            if not words or line.lstrip().startswith("#"):
                self._note_name(line)
            elif rows or not all(number_of(word) is None for word in words):  # else a header without its mark
                rows.append((number, words))
            if len(rows) > MAX_POSES:
                raise _invalid(f"{file.name} line {number}", f"more than {MAX_POSES} poses are not read.")
        lengths = Counter(len(words) for _, words in rows if len(words) in _COLUMNS)
        columns = lengths.most_common(1)[0][0] if lengths else 0
        for number, words in rows:
            self._add(number, words, columns)
        if not self.poses:
            raise next(
                (one.problem for one in self.left_out if one.problem), _invalid(file.name, "holds no pose.")
            )
        self.dialect = _COLUMNS[columns]
        self.image_names = [self.name_of_time.get(time, "") for time in self.times_s]
        list_file = file.with_name(IMAGES_OF.format(stem=file.stem))
        self.files = [file]
        if not self.times_s and list_file.is_file():
            self.files.append(list_file)
            self.image_names = read_text(list_file).splitlines()
            if len(self.image_names) != len(self.poses):
                raise _invalid(
                    list_file.name, f"names {len(self.image_names)} images for {len(self.poses)} poses."
                )
        if len(set(self.times_s)) != len(self.times_s):
            raise _invalid(file.name, "two poses have the same time.")

    def _add(self, number: int, words: list[str], columns: int) -> None:
        """The pose of a line; a bad line with a time is left out, one without keeps its place among the others."""
        where = f"{self.file.name} line {number}"
        found = attempt(partial(_pose_of, words, columns, where))
        if not isinstance(found, InputError):
            time, pose = found
            self.poses.append(pose)
            self.times_s += [] if time is None else [time]
            self.lines.append(number)
            return
        self.left_out.append(PoseEntry(f"line {number}", None, where, problem=found))
        if columns != 8:
            self.problems[len(self.poses)] = self.left_out.pop()
            self.poses.append(np.eye(4))
            self.lines.append(number)

    def _note_name(self, line: str) -> None:
        match = _NAMED_TIME.match(line.strip())
        time = number_of(match[1]) if match else None
        if match and time is not None:
            self.name_of_time[time] = match[2]

    def names(self) -> list[str]:
        """A name for each pose: the image's where the file has one, else the time, else the pose's number from 0."""
        if not self.times_s:
            return self.image_names or [str(index) for index in range(len(self.poses))]
        return [name or f"{time:.17g}" for name, time in zip(self.image_names, self.times_s, strict=True)]


def _pose_of(words: list[str], columns: int, where: str) -> tuple[float | None, NDArray[np.float64]]:
    """The time, where the form has it, and the pose of a line."""
    if len(words) not in _COLUMNS or len(words) != columns:
        raise _invalid(where, f"has {len(words)} numbers, not 8 or 7 (TUM) or 12 (KITTI) as every line.")
    values = finite_numbers(words, where, _HINT)
    if columns < 12:
        *time, a, b, c, x, y, z, w = values.tolist()
        return (time[0] if time else None), matrix_of_pose(rigid_pose([w, x, y, z, a, b, c], where, _HINT))
    return None, rigid_matrix(values.reshape(3, 4).tolist(), where)[0]


def _invalid(where: str, what: str, code: str = "pose_file_invalid") -> InputError:
    return InputError(code, what, where=where, hint=_HINT)
