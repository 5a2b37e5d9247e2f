"""Which poses of a folder are read, and which images beside them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from fnmatch import fnmatch
from pathlib import Path

from biresnerf.data.formats.codec import Codec
from biresnerf.data.formats.registry import ALL_CODECS
from biresnerf.data.formats.unread_poses import refuse_unread
from biresnerf.data.photos.photo_folders import (
    IMAGE_FOLDER,
    few_names,
    folders_of_photos,
    no_images,
    photos_beside,
    visible,
)
from biresnerf.data.photos.video.video_frames import VIDEO_FRAMES, is_video_name
from biresnerf.errors import InputError

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
    found = list(_pose_places(root))
    if found:
        name, place = found[0]
        image_root = ALL_CODECS[name].image_root(place) if place == root else root
        return FolderContents(image_root, name, place, (), _notes(root, found))
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

    Photos in a folder of their own may well be frames of the video. One that is called as a photo beside it was taken
    with that photo by a phone, and is no more than it.
    """
    if any(path.parent != root for path in photos):
        return []
    names = {path.stem.casefold() for path in photos}
    return [path for path in videos if path.stem.casefold() not in names]


def look_at(file: Path) -> FolderContents:
    """What the user means by naming one file: poses, in the format of its name, with images beside it; or a video.

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
            return 3
        if file.name in codec.format.found_as or place != file:
            return 0
        return 2 if codec.recognises is Path.is_file else 1

    # A name that a format declares goes before what a file begins with, and that before a suffix, which several share.
    for name, codec in sorted(readable, key=doubt):
        place = codec.place_of(file)
        if place is not None:
            return FolderContents(codec.image_root(place), name, place, (), ())
    raise InputError(
        "input_unsupported",
        "is neither a folder nor a file with poses that is read.",
        where=file.name,
        hint="Give a transforms.json, a video, or a folder that holds poses or images.",
    )


def usual_name(file: Path) -> str | None:
    """The name under which `look_into` finds such a file in its folder; None where it is one of several files."""
    contents = look_at(file)
    if contents.format is None or contents.poses != file:
        return None
    return ALL_CODECS[contents.format].format.found_as[0].replace("*", "cameras")


def _pose_places(root: Path) -> Iterator[tuple[str, Path]]:
    """All poses in ``root`` by the name of their format, those that are preferred first."""
    for name, codec in ALL_CODECS.items():
        for pattern in codec.format.found_as:
            places = [root / pattern]
            if set("*[") & set(pattern):
                places = [path for path in visible(root) if fnmatch(path.name.lower(), pattern)]
            yield from ((name, place) for place in places if codec.recognises(place))


def _notes(root: Path, found: list[tuple[str, Path]]) -> tuple[str, ...]:
    if len(found) == 1:
        return ()
    read, *others = (path.relative_to(root).as_posix() for _, path in found)
    were = "was not" if len(others) == 1 else "were not"
    return (f"{read} was read and {', '.join(others)} {were}",)
