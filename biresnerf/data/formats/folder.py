"""Which poses of a folder are read, and which images beside them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from fnmatch import fnmatch
from pathlib import Path

from biresnerf.data.formats.codec import Codec
from biresnerf.data.formats.registry import ALL_CODECS
from biresnerf.data.formats.unread_poses import folders_of_set, refuse_unread
from biresnerf.data.photos.named_images import lies_in
from biresnerf.data.photos.photo_folders import (
    IMAGE_FOLDER,
    all_photos,
    few_names,
    folders_of_photos,
    images_beside,
    images_in,
    is_photo_name,
    no_images,
    photos_beside,
    visible,
)
from biresnerf.data.photos.video.video_frames import VIDEO_FRAMES, is_video_name
from biresnerf.errors import InputError

# Parts that sets for training are split into.
_PARTS = frozenset({"train", "training", "test", "testing", "val", "valid", "validation", "eval"})
# Folders that are part of the names of photos, also where there is nothing beside them.
_NAMED_IN_SETS = (IMAGE_FOLDER, VIDEO_FRAMES)


@dataclass(frozen=True)
class FolderContents:
    """What is read: the poses in ``poses`` (a file, or a COLMAP model's folder), or ``images`` where there are none.

    Attributes:
        root: the folder that images lie in or below.
        format: the name of the poses' format; None where there are none.
        notes: what was found and is not read.
        videos: whose frames are photos, too; only where there are no poses.
    """

    root: Path
    format: str | None
    poses: Path | None
    images: tuple[Path, ...]
    notes: tuple[str, ...]
    videos: tuple[Path, ...] = ()


def look_into(folder: Path) -> FolderContents:
    """Finds what to read in ``folder``: poses in the format of the first rank, else the photos where they usually lie.

    A folder that holds nothing but one folder (an unpacked archive) stands for that one.

    Raises:
        InputError: ``no_images`` where it holds neither; says what it holds; ``poses_not_read`` where it holds poses of
            a program whose form is not read.
    """
    root = folder
    for _ in range(3):
        entries = [entry for entry in visible(root) if entry.name != "__MACOSX"]
        if len(entries) != 1 or not entries[0].is_dir() or entries[0].name in _NAMED_IN_SETS:
            break
        root = entries[0]
    found = _found(root)
    if found:
        first = found[0]
        return FolderContents(
            _with_photos(first.root, root), first.format, first.place, (), _notes(root, found)
        )
    refuse_unread(root)
    images, videos, notes = _photos_alone(root)
    if not images and not videos:
        raise no_images(root, "holds no photo")
    return FolderContents(root, None, None, tuple(images), notes, tuple(videos))


def _photos_alone(root: Path) -> tuple[list[Path], list[Path], tuple[str, ...]]:
    """The photos of a folder without poses, videos that belong to them, and a note on folders that are passed over."""
    photos = list(photos_beside(root).values())
    folders = folders_of_photos(root)
    if not photos:
        photos = [path for paths in folders.values() for path in paths]
    videos = [path for path in visible(root) if is_video_name(path) and path.is_file()]
    if videos:  # whose frames are written there
        photos = [path for path in photos if path.relative_to(root).parts[0] != VIDEO_FRAMES]
        folders.pop(VIDEO_FRAMES, None)
    taken = {path.relative_to(root).parts[0] for path in photos}
    others = [f"{name}/ ({len(paths)})" for name, paths in folders.items() if name not in taken]
    notes = (f"photos in other folders are left out: {few_names(others)}",) if others else ()
    return photos, _videos_beside(root, videos, photos), notes


def _videos_beside(root: Path, videos: Sequence[Path], photos: Sequence[Path]) -> list[Path]:
    """The videos whose frames count as photos: where there are no others, or these lie in the same folder.

    Photos in a folder of their own may well be frames of the video. A video named like a photo beside it was taken with
    that photo by a phone, and shows no more.
    """
    if any(path.parent != root for path in photos):
        return []
    names = {path.stem.casefold() for path in photos}
    return [path for path in videos if path.stem.casefold() not in names]


def look_at(file: Path, within: Path | None = None) -> FolderContents:
    """What the user means by naming one file: poses, in the format of its name, with images beside it; or a video.

    Where its folder holds no photo, those of the folder above may be meant, unless that leads out of ``within``.

    Raises:
        InputError: ``input_unsupported``.
    """
    if is_video_name(file):
        return FolderContents(file.parent, None, None, (), (), (file,))
    readable = [(name, codec) for name, codec in ALL_CODECS.items() if codec.parse is not None]

    def doubt(item: tuple[str, Codec]) -> int:
        codec = item[1]
        place = codec.place_of(file)
        if place is None or not codec.recognises(place):
            return 3 + (file.name not in codec.format.found_as)
        if file.name in codec.format.found_as or place != file:
            return 0
        return 2 if codec.loose or codec.recognises is Path.is_file else 1

    # A name that a format declares goes before what a file begins with, and that before a suffix, which several share.
    for name, codec in sorted(readable, key=doubt):
        place = codec.place_of(file)
        if place is not None:
            return FolderContents(_or_above(codec.image_root(place), within), name, place, (), ())
    raise InputError(
        "input_unsupported",
        "is neither a folder nor a file with poses that is read.",
        where=file.name,
        hint="Give a transforms.json, a video, or a folder that holds poses or images.",
    )


def _or_above(root: Path, within: Path | None) -> Path:
    """``root``, or the folder above it where only that one holds photos, or one of its folders."""
    above = root.absolute().parent
    if all_photos(root) or (within is not None and not lies_in(above, within.resolve())):
        return root
    try:
        holds = any(map(images_beside, [above, *(path for path in visible(above) if path.is_dir())]))
    except InputError:  # not ours to read
        return root
    return above if holds else root


def usual_name(file: Path) -> str | None:
    """The name under which `look_into` finds such a file in its folder; None where it is one of several files."""
    contents = look_at(file)
    if contents.format is None or contents.poses != file:
        return None
    return ALL_CODECS[contents.format].format.found_as[0].replace("*", "cameras")


def other_parts_notes(top: Path, used: Sequence[Path]) -> list[str]:
    """A note on photos in folders of ``top`` called as parts of a set (test/, val/), where none is ``used``."""
    taken = {parent for path in used for parent in path.absolute().parents}
    left: dict[str, int] = {}
    for folder, _, _ in folders_of_set(top.absolute()):
        inside = folder.relative_to(top.absolute())
        if _PARTS.isdisjoint(part.casefold() for part in inside.parts) or folder in taken:
            continue
        if photos := images_in(folder):
            left[f"{inside.as_posix()}/"] = len(photos)
    if not left:
        return []
    listed = few_names([f"{name} ({count})" for name, count in left.items()])
    return [
        f"photos of other parts of the set are left out: {listed}. They can join the result: with a folder of all "
        "photos and --fixed-from OUT (over HTTP fixed_from)"
    ]


@dataclass(frozen=True)
class _Found:
    """Poses of a format in the file or folder ``place``; photos lie in or below ``root``, if there are some."""

    format: str
    place: Path
    root: Path


def _found(root: Path) -> list[_Found]:
    """All poses of a set, the first of which is read: those in ``root`` itself, else the nearest in folders below.

    A model without photos beside it yields to one with photos, such as programs write that undistort photos.
    """
    here = list(_pose_places(root))
    if here and (ALL_CODECS[here[0].format].count is None or images_beside(here[0].root)):
        return here
    below = [
        one
        for folder in _folders_below(root)
        for one in _pose_places(folder)
        if not ALL_CODECS[one.format].loose
    ]
    if here:
        return [*(one for one in below if one.format == here[0].format and images_beside(one.root)), *here]
    return sorted(below, key=_from_set)


def _from_set(one: _Found) -> tuple[bool, int, int, int]:
    """Sorts poses with photos beside them (not those of a camera's path) first, then the nearest, then the largest."""
    photos, codec = len(all_photos(one.root)), ALL_CODECS[one.format]
    images = photos if codec.count is None else codec.count(one.place)
    return not photos, len(one.root.parts), codec.format.rank, -images


def _folders_below(root: Path) -> list[Path]:
    """The folders below ``root`` that may hold poses of the set, the nearest first."""
    found = [
        folder
        for folder, folders, files in folders_of_set(root)
        if folder != root and (folders or not all(map(is_photo_name, files)))
    ]
    return sorted(found, key=lambda folder: (len(folder.parts), folder))


def _with_photos(folder: Path, top: Path) -> Path:
    """``folder``, or the nearest above it, up to ``top``, that holds photos where it holds none."""
    for place in (folder, *folder.parents):
        if place == top or not place.is_relative_to(top) or all_photos(place):
            return place
    return folder


def _pose_places(root: Path) -> Iterator[_Found]:
    """The poses in the folder ``root``, those that are preferred first."""
    for name, codec in ALL_CODECS.items():
        for pattern in codec.format.found_as:
            places = [root / pattern]
            if set("*[") & set(pattern):
                places = [path for path in visible(root) if fnmatch(path.name.lower(), pattern)]
            for place in places:
                if codec.recognises(place):
                    yield _Found(
                        name, _largest(codec, place), codec.image_root(place) if place == root else root
                    )


def _largest(codec: Codec, place: Path) -> Path:
    """Of places that differ only by a number (sparse/0, sparse/1), the one with most images."""
    if codec.count is None or not place.name.isdecimal():
        return place
    numbered = [path for path in visible(place.parent) if path.name.isdecimal() and codec.recognises(path)]
    return max(sorted(numbered, key=lambda path: int(path.name)), key=codec.count)


def _notes(root: Path, found: Sequence[_Found]) -> tuple[str, ...]:
    names = dict.fromkeys(one.place.relative_to(root).as_posix() for one in found)
    read, *others = ("the folder itself" if name == "." else name for name in names)
    if not others:
        return (f"poses were read from {read}",) if root not in (found[0].root, found[0].place) else ()
    were = "was not" if len(others) == 1 else "were not"
    return (f"{read} was read and {few_names(others, 12)} {were}",)
