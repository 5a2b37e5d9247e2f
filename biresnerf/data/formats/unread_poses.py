"""Detects poses in forms that are not read, so that no set is silently treated as photos alone.

Forms of known programs are recognised by name and first bytes; other files by their numbers, which are as many as
poses of the photos would be, or stand beside the photos' names.
"""

from __future__ import annotations

import os
import re
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from fnmatch import fnmatch
from pathlib import Path, PurePosixPath

import numpy as np

from biresnerf.data.formats.codec import head_of
from biresnerf.data.photos.photo_folders import few_names, is_photo_name
from biresnerf.errors import InputError

_DEPTH = 4  # of folders that are looked into: dslr/colmap/, dense/0/sparse/
_MOST_FOLDERS = 2_000
_RESULT = {"report.json", "config.json"}  # what a result of ours holds
_MOST_FILES, _MOST_BYTES = 300, 4 * 2**20
_TABLES = re.compile(r"\.(txt|json|ya?ml|csv|tsv|log|out|dat|xml|geojson|traj|cam|npy)$", re.I)
_NO_POSES = re.compile(r"\.(xmp|aae|thm|md|html|py|sh|ply|obj|mtl)$", re.I)
# Numbers of a pose in one row: a quaternion or a matrix of 9, 12 or 16, a time or a number before it, a lens beside it.
_OF_POSE = (7, 8, 9, 12, 13, 16, 17, 19, 20, 25)
_MOST_A_PHOTO = 50  # rows; a trajectory has more poses than photos, and points are more than these
_MOST_LINES = 200  # a photo
_NUMBER = re.compile(r"[-+]?(\d+(\.\d*)?|\.\d+)([eE][-+]?\d+)?")
_INNERMOST = re.compile(r"[\[({]([^\[\](){}]*)[\])}]")


@dataclass(frozen=True)
class UnreadForm:
    """What a program calls its files, as globs in a folder, and what the first bytes match."""

    program: str
    names: tuple[str, ...]
    begins: bytes = b""


UNREAD = (
    UnreadForm("ContextCapture (BlocksExchange)", ("*.xml",), rb"(?s).*<BlocksExchange"),
    UnreadForm("Pix4D", ("*calibrated_external_camera_parameters.txt",), rb"imageName"),
    UnreadForm("VisualSFM", ("*.nvm",), rb"NVM_V"),
    UnreadForm("OpenMVS", ("*.mvs",), rb"MVS"),
    UnreadForm("Stray Scanner", ("odometry.csv",), rb"timestamp"),
    UnreadForm("EasyMocap", ("extri.yml",), rb"(?s).*opencv-matrix"),
    UnreadForm("ARKitScenes", ("*.traj",), rb"\s*([-+]?[\d.]+(e[-+]?\d+)?\s+){7}"),
)


def _unread_form(path: Path) -> UnreadForm | None:
    """The unread form of a file that holds camera poses of a program; None for other files."""
    called = (form for form in UNREAD if any(fnmatch(path.name, name) for name in form.names))
    return next((form for form in called if re.match(form.begins, head_of(path))), None)


def refuse_unread(root: Path) -> None:
    """Raise `InputError` ``poses_not_read`` if the folder holds poses of a program whose form is not read."""
    for path in sorted(root.iterdir()):
        if (form := _unread_form(path)) is not None:
            raise InputError(
                "poses_not_read",
                f"holds camera poses of {form.program}, a form that is not read.",
                where=path.name,
                hint="Convert them to one of the formats of docs/formats.md, or move them out of the folder to have "
                "the poses found from the photos alone.",
            )


def folders_of_set(root: Path) -> Iterator[tuple[Path, list[str], list[str]]]:
    """The folders in which files of a set are looked for, with the names of the folders and files in each.

    Hidden folders and those of our results are left out.
    """
    for count, (parent, folders, files) in enumerate(os.walk(root)):
        folders[:] = sorted(name for name in folders if not name.startswith((".", "__")))
        if set(files) >= _RESULT or count > _MOST_FOLDERS:
            folders.clear()
            continue
        yield Path(parent), list(folders), sorted(name for name in files if not name.startswith("."))
        if len(Path(parent).relative_to(root).parts) == _DEPTH:
            folders.clear()


def pose_like_notes(root: Path, names: Sequence[str], known: Sequence[Path] = ()) -> list[str]:
    """A note on files that may hold poses of the photos ``names``, except ``known`` ones."""
    stems = {_stem(name) for name in names}
    found: list[str] = []
    notes: list[str] = []
    for folder, _, files in folders_of_set(root):
        others = [folder / name for name in files if not is_photo_name(name) and folder / name not in known]
        notes += [
            f"{path.relative_to(root).as_posix()} holds camera poses of {form.program}, which are not read"
            for path in others
            if (form := _unread_form(path)) is not None
        ]
        own = [path for path in others if _stem(path.name) in stems and not _NO_POSES.search(path.name)]
        if len(own) >= max(3, len(stems) / 2):
            if _one_pose_each(own):
                found.append(
                    f"{(folder / own[0].name).relative_to(root).as_posix()} and {len(own) - 1} like it"
                )
            continue
        tables = [path for path in others if _TABLES.search(path.name)][:_MOST_FILES]
        found += [path.relative_to(root).as_posix() for path in tables if _like_poses(path, names)]
    if not found:
        return notes
    return [
        *notes,
        f"{few_names(found, 3)} may hold poses, by what numbers they hold, and were not read: "
        "give poses in one of the forms of docs/formats.md",
    ]


def _stem(name: str) -> str:
    return PurePosixPath(name).name.split(".")[0].casefold()


def _one_pose_each(files: Sequence[Path]) -> bool:
    """Whether files called as photos hold as many numbers each as a pose, alone or with a lens."""
    counts = {sum(map(_is_number, _words(_text(path)))) for path in files[:3]}
    return len(counts) == 1 and 7 <= counts.pop() <= 64


def _like_poses(path: Path, names: Sequence[str]) -> bool:
    """Whether the numbers in a file could be poses of as many photos."""
    photos = len(names)
    if path.suffix.lower() == ".npy":
        shape = _shape(path)
        return len(shape) > 1 and shape[0] >= photos and int(np.prod(shape[1:])) in _OF_POSE
    text = _text(path)
    if text.count("\n") > _MOST_LINES * photos:
        return False
    words = _words(text)
    numbers = sum(map(_is_number, words))
    there = {word.replace("\\", "/").rpartition("/")[2].casefold() for word in words}
    there |= {word.partition(".")[0] for word in there}
    there = {word for word in there if not word.isdecimal()}
    named = sum(not there.isdisjoint({PurePosixPath(name).name.casefold(), _stem(name)}) for name in names)
    if named >= max(3, photos / 2) and numbers >= 7 * named:
        return True
    rows = Counter(sum(map(_is_number, _words(line))) for line in text.splitlines())
    rows += Counter(sum(map(_is_number, _words(part))) for part in _INNERMOST.findall(text))
    whole = any(photos <= rows[count] <= _MOST_A_PHOTO * photos for count in _OF_POSE)
    return whole or any(rows[4] == height * photos for height in (3, 4))


def _shape(path: Path) -> tuple[int, ...]:
    try:
        return tuple(np.load(path, mmap_mode="r", allow_pickle=False).shape)
    except (OSError, ValueError):
        return ()


def _text(path: Path) -> str:
    try:
        with path.open("rb") as file:
            return file.read(_MOST_BYTES).decode("utf-8", "replace")
    except OSError:
        return ""


def _words(text: str) -> list[str]:
    return re.split(r"[\s,;:=<>|'\"()\[\]{}]+", text)


def _is_number(word: str) -> bool:
    return _NUMBER.fullmatch(word) is not None
