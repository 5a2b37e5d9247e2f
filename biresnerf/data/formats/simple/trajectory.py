"""Trajectories of SLAM tools: TUM (position, quaternion, mostly a time), KITTI (12 numbers), a camera beside them.

A bad line costs one pose, not the file.
"""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from biresnerf.data.formats.codec import Codec, head_of
from biresnerf.data.formats.match_names import match_files
from biresnerf.data.formats.parsed_poses import Assignment, ParsedPoses, PoseEntry
from biresnerf.data.formats.pose_rows import MAX_ROWS, Placed, entry_of, pose_by, pose_of_numbers
from biresnerf.data.formats.simple.camera_file import read_camera_file
from biresnerf.data.formats.simple.times_of_images import (
    MAX_TIME_APART_S,
    TIMES_OF_IMAGES,
    nearest_poses,
    number_of,
    times_of_images,
)
from biresnerf.data.model.atomic_file import write_text
from biresnerf.data.model.dataset import SourceFormat
from biresnerf.data.model.image_order import names_of_poses
from biresnerf.data.model.refined_set import RefinedSet
from biresnerf.data.model.untrusted_file import finite_numbers, invalid_file, read_text
from biresnerf.data.photos.photo_folders import few_names
from biresnerf.errors import InputError
from biresnerf.geometry.rigid import quat_wxyz_from_rotation
from biresnerf.options.formats import Format

TRAJECTORY = Format(
    name="trajectory",
    title="TUM, KITTI",
    rank=80,
    found_as=(
        "trajectory.txt",
        "tum.txt",
        "kitti.txt",
        "poses.txt",
        "pose.txt",
        "groundtruth.txt",
        "CameraTrajectory.txt",
        "KeyFrameTrajectory.txt",
        "[0-9][0-9].txt",
    ),
    suffixes=(".txt",),
    gives="poses, TUM's times; a lens beside them",
    checked_against="SciPy's quaternions (TUM); its description (KITTI)",
)
TUM = Format(
    name="tum",
    title="TUM trajectory",
    rank=81,
    in_set="tum.txt",
    always=True,
    needs=("lens file",),
    loses=("lenses", "rigs", "points", "mask paths"),
    heading="For evo and SLAM tools",
    hint="A trajectory in TUM format",
    quaternion="xyzw",
)
KITTI = Format(
    name="kitti",
    title="KITTI trajectory",
    rank=82,
    in_set="kitti.txt",
    needs=("lens file",),
    loses=("lenses", "rigs", "points", "mask paths"),
    heading="For odometry tools",
    hint="A trajectory in KITTI format",
)

_PHOTO_FOLDERS = ("image_2", "image_0", "image_3", "image_1")  # KITTI's: the colour cameras first
_LEAST_CLOCK = 1e8  # s; smaller whole numbers in names count photos, as a rule
_FRAME_RATE = 30  # at which MASt3R-SLAM takes photos of a folder; it writes poses of some
_HEAD = "# timestamp tx ty tz qx qy qz qw: camera to world, OpenCV axes (x right, y down, z forward), the input's frame"
IMAGES_OF = "{stem}_images.txt"  # beside our KITTI files, which have no room for names: an image a line
_HINT = "Give lines of `time x y z qx qy qz qw` (TUM; without times, as many as images), or [R | t] by rows (KITTI)."
_COLUMNS: dict[int, str] = {7: "tum", 8: "tum", 12: "kitti"}
# What `refine` writes above its poses: which image was taken when.
_NAMED_TIME = re.compile(r"#\s*([-+0-9.eE]+)\s+(\S.*\S|\S)\s*$")


class Trajectory:
    """Poses in the file's order, named by their images, times or numbers; bad ones of a file without times included.

    ``times_s`` and the names of images by time are there where the file has them; ``left_out`` are the bad lines of a
    file with times.
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
                raise invalid_file(
                    f"{file.name} line {number}", f"more than {MAX_ROWS} poses are not read.", _HINT
                )
        lengths = Counter(len(words) for _, words in rows if len(words) in _COLUMNS)
        columns = lengths.most_common(1)[0][0] if lengths else 0
        read = [entry_of(where, where, partial(_read, words, columns, where)) for where, words in rows]
        timed = columns == 8
        entries = [entry for entry in read if not timed or entry.problem is None]
        self.left_out = [entry for entry in read if timed and entry.problem is not None]
        if not any(entry.problem is None for entry in entries):
            raise next(
                (one.problem for one in read if one.problem), invalid_file(file.name, "holds no pose.", _HINT)
            )
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
                raise invalid_file(
                    list_file.name, f"names {len(self.image_names)} images for {len(entries)} poses.", _HINT
                )
        if len(set(self.times_s)) != len(self.times_s):
            raise invalid_file(file.name, "two poses have the same time.", _HINT)
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
        raise invalid_file(
            where, f"has {len(words)} numbers, not 8 or 7 (TUM) or 12 (KITTI) as every line.", _HINT
        )
    values = finite_numbers(words, where, _HINT)
    if columns == 12:
        return pose_by(KITTI, values.reshape(3, 4), where), None
    x, y, z, *quaternion = values[-7:].tolist()
    return pose_of_numbers(TUM, quaternion, (x, y, z), where, _HINT), None


def parse_trajectory(root: Path, file: Path) -> ParsedPoses:
    """The poses of the trajectory ``file``, camera to world with OpenCV axes.

    Which pose belongs to which image is decided by the first of these that applies: names in the file's own comments
    (TUM) or in the list beside it that `write_kitti` writes;
    rgb.txt (times and names, as in TUM's sets) or images named by their time, nearest within 0.02 s; times that are the
    images' numbers from 0, or that divided by 30 (MASt3R-SLAM); as many poses as images, in order. The camera is that
    of `read_camera_file`, else a guess.
    KITTI's poses are those of camera 0; its calib.txt says how the camera of image_2/ is mounted beside it.
    """
    trajectory = Trajectory(file)
    lens, cam_from_pose, camera_files = read_camera_file(root, _PHOTO_FOLDERS)
    pose_from_cam = np.linalg.inv(cam_from_pose)
    times: Sequence[float | None] = trajectory.times_s or [None] * len(trajectory.entries)
    entries = [
        replace(
            entry,
            world_from_cam=None if entry.world_from_cam is None else entry.world_from_cam @ pose_from_cam,
            lens=lens,
            timestamp_s=time,
        )
        for entry, time in zip(trajectory.entries, times, strict=True)
    ]

    def assign(names: Sequence[str]) -> Assignment:
        pose_of, how = matched(trajectory, names, root)
        pairs = [
            (name, replace(entries[pose_of[name]], name=name))
            if name in pose_of
            else (name, PoseEntry(name, None, file.name, lens))
            for name in names
        ]
        return pairs, [f"{file.name}: images and poses were matched {how}"]

    table = [root / TIMES_OF_IMAGES] if (root / TIMES_OF_IMAGES).is_file() else []
    source = SourceFormat(trajectory.dialect, files=(*trajectory.files, *camera_files, *table))
    every = (*entries, *trajectory.left_out)
    return ParsedPoses(source, every, assign, named=False, photo_folders=_PHOTO_FOLDERS)


def matched(trajectory: Trajectory, names: Sequence[str], root: Path) -> tuple[dict[str, int], str]:
    """Which pose (by index) each image has, and how that was found out: the rules of `parse_trajectory`.

    Args:
        names: of the images, sorted.
        root: the folder that may hold rgb.txt.

    Raises:
        InputError: ``pose_count_mismatch``.
    """
    count, times = len(trajectory.entries), trajectory.times_s
    named = trajectory.image_names
    if named and all(named) and len(set(named)) == count:
        found, _ = match_files(named, names)
        if len(found) == count:
            how = "in its comments" if times else "in the list beside it"
            return {found[name]: index for index, name in enumerate(named)}, f"by the names {how}"
        if not times:  # such a list names images, comments may be about something else
            missing = [name for name in named if name not in found]
            raise InputError(
                "image_missing",
                f"{len(missing)} of {count} images not found: {few_names(missing)}.",
                where=trajectory.file.name,
                hint="Put the images into images/ under the names that the list has.",
            )
    if times:
        taken, by = times_of_images(names, root)
        nearest = nearest_poses(taken, times)
        numbers = all(time == math.floor(time) and 0 <= time < len(names) for time in times)
        counted = all(time == math.floor(time) < _LEAST_CLOCK for time in taken.values())
        # Whole numbers may be names, or count from 0 what names count from 1: then not all of them meet. Numbers that
        # count photos meet a few times by chance.
        share = 1.0 if numbers else 0.9 if counted else 0.5
        if taken and len(nearest) >= share * (count if numbers else min(count, len(names))):
            return nearest, f"by time ({by}, at most {MAX_TIME_APART_S} s apart)"
        if numbers:
            by_number = {names[int(time)]: i for i, time in enumerate(times)}
            return by_number, "by number, in the order of the images' names"
        frames = [round(time * _FRAME_RATE) for time in times]
        off = np.abs(np.array(times) * _FRAME_RATE - frames).max()
        if count < len(names) and off < 1e-3 and set(frames) <= set(range(len(names))):
            by_frame = {names[frame]: i for i, frame in enumerate(frames)}
            return by_frame, f"by number, {_FRAME_RATE} images a second, in the order of the images' names"
    if count == len(names):
        ordered, note = names_of_poses(names, [entry.world_from_cam for entry in trajectory.entries])
        how = "in the order of the images' names" + (note and f"; {note}")
        return {name: i for i, name in enumerate(ordered)}, how
    raise InputError(
        "pose_count_mismatch",
        f"has {count} poses for {len(names)} images, and does not say which belongs to which.",
        where=trajectory.file.name,
        hint="Name images by their time (s, ms, us or ns, on the poses' clock), add rgb.txt (time and name a line), or "
        "give one pose an image.",
    )


def _is_trajectory(file: Path) -> bool:
    """Whether the file is named as a trajectory; for vaguer names, whether its first line is one of a trajectory."""
    sequence = file.stem.isdecimal()  # KITTI's are called by numbers
    if not file.is_file() or not (sequence or file.stem == "pose"):
        return file.is_file()
    words = head_of(file).partition(b"\n")[0].split()
    lengths = (12,) if sequence else (7, 8, 12)
    return len(words) in lengths and all(number_of(word.decode("latin-1")) is not None for word in words)


def write_tum(refined: RefinedSet, path: Path) -> None:
    """One line an image: time (s), centre, quaternion with the scalar last.

    Times are the input's; where it had none, the images' numbers, counted from 0 in the input's order. Comments
    at the top say which image each is.
    """
    times = refined.timestamps_s or tuple(float(i) for i in range(len(refined)))
    lines = [_HEAD]
    lines += [f"# {time!r} {image.name}" for time, image in zip(times, refined.images, strict=True)]
    for time, pose in zip(times, refined.world_from_cam, strict=True):
        w, x, y, z = quat_wxyz_from_rotation(pose[:3, :3]).tolist()
        lines.append(" ".join(repr(value) for value in (time, *pose[:3, 3].tolist(), x, y, z, w)))
    _write_lines(path, lines)


def write_kitti(refined: RefinedSet, path: Path) -> None:
    """One line an image, in the set's order: the 12 numbers of [R | t], row by row.

    The format has neither names nor comments, so a list beside it, NAME_images.txt, names the image of each line.
    """
    rows = [" ".join(repr(value) for value in pose[:3].ravel().tolist()) for pose in refined.world_from_cam]
    _write_lines(
        path.with_name(IMAGES_OF.format(stem=path.stem)), [image.file_name for image in refined.images]
    )
    _write_lines(path, rows)


def _write_lines(path: Path, lines: list[str]) -> None:
    # A name may hold anything but what ends a line.
    write_text(path, "\n".join(" ".join(line.splitlines()) for line in lines))


CODECS = (
    Codec(TRAJECTORY, parse=parse_trajectory, recognises=_is_trajectory, loose=True),
    Codec(TUM, write=lambda refined, path, _: write_tum(refined, path)),
    Codec(
        KITTI,
        write=lambda refined, path, _: write_kitti(refined, path),
        given_back=lambda dataset: dataset.source.dialect == "kitti",
    ),
)
