"""Where the photos of a set lie, and what else lies there that is not read."""

from __future__ import annotations

import os
import posixpath
import re
from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator, Sequence
from itertools import islice
from pathlib import Path

from biresnerf.data.model.image_order import natural_key
from biresnerf.data.photos.image_files import greyness, is_image_name
from biresnerf.data.photos.kinds.photo_kinds import INSTALL, KIND_OF, PHOTO_KINDS, is_readable
from biresnerf.data.photos.named_images import lies_in
from biresnerf.data.photos.video.ffmpeg_frames import DEMUXERS
from biresnerf.errors import InputError

IMAGE_FOLDER = "images"
# Folders of the photos themselves where others hold something else of the same views; the preferred one first.
_USUAL = ("rgb", "color", "colour", "image", "image_2", "image_0", "train")
# Folders of the photos of images/ at a half, a quarter or so of their size, as LLFF and nerfstudio write them.
COPIES = re.compile(rf"{IMAGE_FOLDER}_(\d+)")
# Words by which programs call what they make of photos: maps and small copies, in files beside them or in folders.
_MAPS = frozenset({
    "mask", "masks", "matte", "alpha", "depth", "depths", "depthmap", "depthmaps", "disparity", "disp", "conf",
    "confidence", "normal", "normals", "semantic", "semantics", "segmentation", "seg", "instance", "label", "labels",
    "flow", "albedo", "roughness", "thumb", "thumbs", "thumbnail", "thumbnails", "preview",
})  # fmt: skip
# Other folders whose pictures are not the set's photos; `biresnerf convert` writes pinhole/.
_NO_PHOTOS = frozenset({"pinhole", "sparse", "sparse_txt", "__macosx"})
# Maps of something else beside a photo, as 7-Scenes, sdfstudio and instant-ngp name them.
_NO_PHOTO = re.compile(
    r"^(dynamic_mask_.*|.*[._-](depth|normal|mask|sensor_depth|confidence)\.(png|tiff?))$", re.I
)
# Pictures that are not read and videos, by their extension.
_NO_PICTURES = {
    ".gif": "GIF", ".jxl": "JPEG XL", ".jxr": "JPEG XR", ".psd": "Photoshop", ".tga": "TGA", ".svg": "SVG",
    ".pdf": "PDF", ".dcm": "DICOM", ".fits": "FITS", ".insp": "Insta360", ".dds": "DDS", ".xcf": "GIMP",
    **dict.fromkeys((".jp2", ".j2k", ".j2c", ".jpf", ".jpx"), "JPEG 2000"),
    **dict.fromkeys((".ppm", ".pgm", ".pnm", ".pbm"), "PNM"),
    **dict.fromkeys(DEMUXERS, "video"),
}  # fmt: skip
_MOST_ENTRIES = 100_000  # looked at for a message


def few_names(names: Iterable[str], limit: int = 5) -> str:
    """A short list for a message: the first ``limit`` names and how many more."""
    listed = list(names)
    more = f" and {len(listed) - limit} more" if len(listed) > limit else ""
    return ", ".join(listed[:limit]) + more


def photos_beside(root: Path, folders: Sequence[str] = ()) -> dict[str, Path]:
    """The photos beside poses, by path with forward slashes; empty where there are none, or none can be chosen.

    Those in the first of ``folders`` that has some, which the poses' program uses; else those of `images_beside`; else
    those in the one other folder that has some; of several, in the first with a usual name for a folder of photos
    (rgb/, color/, image_2/), or in all of them where their names differ only by a number (cam0/, cam1/). Of images_4/
    and images_8/, which hold smaller copies, the first counts.
    """
    for name in folders:
        paths = images_below(root / name)
        if paths:
            return by_path(root, paths)
    beside = images_beside(root)
    if beside:
        return beside
    found = _largest_copies(folders_of_photos(root))
    if len({re.sub(r"\d+", "", name) for name in found}) == 1:
        return by_path(root, [path for paths in found.values() for path in paths])
    usual = next((name for name in _USUAL if name in found), None)
    return by_path(root, found[usual]) if usual else {}


def _largest_copies(folders: dict[str, list[Path]]) -> dict[str, list[Path]]:
    """The folders without smaller copies of the photos of one of them: images_8/ beside images_4/."""
    times = {name: int(found[1]) for name in folders if (found := COPIES.fullmatch(name))}
    least = min(times.values(), default=0)
    return {name: paths for name, paths in folders.items() if times.get(name, least) == least}


def all_photos(root: Path) -> dict[str, Path]:
    """The photos of `photos_beside`, else those in all folders of ``root``: for poses that name their photos."""
    return photos_beside(root) or by_path(
        root, [path for paths in folders_of_photos(root).values() for path in paths]
    )


def photos_named(root: Path, names: Sequence[str]) -> dict[str, Path]:
    """The photos of the folder below ``root`` that holds more than half of ``names``, by their path there; else all.

    Extensions and case may differ, and where no paths fit, file names do. Of several such folders (images_2/,
    images_4/), that of the largest files counts.
    """
    below = images_below(root)
    for whole in (True, False):
        wanted = {_bare(name if whole else posixpath.basename(name)) for name in names}
        found: dict[Path, list[Path]] = defaultdict(list)
        for path in below:
            for folder in path.relative_to(root).parents if whole else [path.parent.relative_to(root)]:
                if _bare(path.relative_to(root / folder).as_posix()) in wanted:
                    found[folder].append(path)
        most = max(map(len, found.values()), default=0)
        if 2 * most > len(wanted):
            best = [folder for folder, paths in found.items() if len(paths) == most]
            folder = root / max(best, key=lambda one: found[one][0].stat().st_size)
            return by_path(folder, [path for path in below if path.is_relative_to(folder)])
    return all_photos(root)


def _bare(name: str) -> str:
    return posixpath.splitext(name.replace("\\", "/").casefold())[0]


def with_named(files: dict[str, Path], root: Path, names: Iterable[str]) -> dict[str, Path]:
    """The photos of ``root`` or its images/, with those that poses name although they are named like maps.

    A photo that was preferred to one of these for its name is then left out.
    """
    asked, limit, files = set(names), root.resolve(), dict(files)
    key_of = {path: key for key, path in files.items()}
    twins = {(path.parent, path.stem.casefold()): key for key, path in files.items() if key not in asked}
    for name in asked - files.keys():
        for place in (root / IMAGE_FOLDER / name, root / name):
            if (
                place in key_of
                or not is_image_name(place)
                or not lies_in(place, limit)
                or not place.is_file()
            ):
                continue
            files.pop(twins.get((place.parent, place.stem.casefold()), ""), None)
            files[name] = place
            break
    return files


def folders_of_photos(root: Path) -> dict[str, list[Path]]:
    """The photos below each folder of ``root``, but folders that hold no photos."""
    folders = [path for path in visible(root) if path.is_dir() and not _holds_no_photos(path.name)]
    return {folder.name: paths for folder in folders if (paths := images_below(folder))}


def by_path(root: Path, paths: Iterable[Path]) -> dict[str, Path]:
    """The files by their path in ``root``, with forward slashes."""
    return {path.relative_to(root).as_posix(): path for path in paths}


def images_beside(root: Path) -> dict[str, Path]:
    """The images in ``root``/images, else in ``root``, by their path there; empty where there are none."""
    paths = images_below(root / IMAGE_FOLDER)
    return by_path(root / IMAGE_FOLDER, paths) if paths else by_path(root, images_in(root))


def visible(folder: Path) -> list[Path]:
    """What a folder holds, without hidden files, sorted. Raises InputError ``input_unreadable``."""
    try:
        return sorted(path for path in folder.iterdir() if not path.name.startswith("."))
    except OSError as error:
        raise InputError(
            "input_unreadable",
            f"cannot be read: {error.strerror}.",
            where=str(folder),
            hint="Check the path and its permissions.",
        ) from None


def images_in(folder: Path) -> list[Path]:
    """The photos in ``folder`` itself, each once, numbers in their names compared as numbers.

    Files named as masks or depth maps are left out.
    """
    return _once([path for path in visible(folder) if is_photo_name(path.name) and path.is_file()])


def images_below(folder: Path) -> list[Path]:
    """The photos in ``folder`` and its folders, sorted, as for `images_in`."""
    return _once([path for path in _files_below(folder) if is_photo_name(path.name)])


def _once(paths: Sequence[Path]) -> list[Path]:
    """The photos without maps of them, and without those also stored in a kind that more programs read."""
    photos = set(paths) - maps_among(paths)
    return sorted(photos - doubled(photos).keys(), key=lambda path: natural_key(path.as_posix()))


def maps_among(paths: Iterable[Path]) -> set[Path]:
    """Pictures named as a map or a small copy of a photo beside them: r_0_depth_0001.png beside r_0.png.

    The photo has the same numbers in its name, or the first of them; names without numbers have the same other words.
    """
    words_of = {path: _words(path.stem) for path in paths}
    called = {path for path, words in words_of.items() if _MAPS & set(words)}
    photos = {(path.parent, _apart(path.stem)) for path in words_of.keys() - called}
    return {
        path
        for path in called
        for what in [_apart(path.stem)]
        if any((path.parent, what[:end]) in photos for end in range(1, len(what) + 1))
    }


def _words(name: str) -> list[str]:
    return re.findall(r"[^\W\d_]+", name.casefold())


def _apart(stem: str) -> tuple[int | str, ...]:
    """What distinguishes a name from others of its kind: its numbers, else its words."""
    return tuple(map(int, re.findall(r"\d+", stem))) or tuple(w for w in _words(stem) if w not in _MAPS)


def _holds_no_photos(folder: str) -> bool:
    return folder.casefold() in _NO_PHOTOS or not _MAPS.isdisjoint(_words(folder))


def doubled(paths: Iterable[Path]) -> dict[Path, Path]:
    """Photos that lie beside the same photo in another kind (HEIC and JPEG), with the one that is used instead.

    The same name in the same folder is the same photo, unless both are PNG, JPEG and the like in colour: a grey one
    beside one in colour is its mask or depth.
    """
    same: dict[tuple[Path, str], list[Path]] = defaultdict(list)
    for path in paths:
        same[path.parent, path.stem.casefold()].append(path)
    found: dict[Path, Path] = {}
    for group in same.values():
        plain = [path for path in group if not _preference(path)]
        levels = {path: greyness(path) for path in plain} if len(plain) > 1 else {}
        grey = {path for path, level in levels.items() if level > min(levels.values())}
        first = min(group, key=lambda path: (path in grey, _preference(path)))
        found |= {path: first for path in group if path != first and (path in grey or _preference(path))}
    return found


def _preference(path: Path) -> int:
    """0 for what every program reads, then by the order of kinds."""
    kind = KIND_OF.get(path.suffix.lower())
    return 0 if kind is None else 1 + PHOTO_KINDS.index(kind)


def is_photo_name(name: str) -> bool:
    """Whether a file is a photo that is read, by its name."""
    return not name.startswith(".") and is_image_name(Path(name)) and not _NO_PHOTO.match(name)


def _files_below(folder: Path) -> Iterator[Path]:
    for parent, folders, files in os.walk(folder):
        folders[:] = sorted(
            name for name in folders if not name.startswith(".") and not _holds_no_photos(name)
        )
        yield from (Path(parent, name) for name in files if not name.startswith("."))


def pictures_left_out(folder: Path) -> dict[str, list[str]]:
    """The names of pictures and videos in or below ``folder`` that are not read, by their kind."""
    found: dict[str, list[str]] = defaultdict(list)
    for path in islice(_files_below(folder), _MOST_ENTRIES):
        kind = _unread_kind(path)
        if kind is not None:
            found[kind].append(path.relative_to(folder).as_posix())
    return {kind: sorted(names) for kind, names in sorted(found.items())}


def _unread_kind(path: Path) -> str | None:
    kind = KIND_OF.get(path.suffix.lower())
    if kind is not None:
        return None if is_readable(kind) else kind.name
    return _NO_PICTURES.get(path.suffix.lower())


def left_out_notes(folder: Path, used: Iterable[Path] = ()) -> tuple[str, ...]:
    """A note for each kind of picture in or below ``folder`` that is not read, without those ``used``."""
    taken = {path.absolute() for path in used}
    unread = {
        kind: left
        for kind, names in pictures_left_out(folder).items()
        if (left := [name for name in names if (folder / name).absolute() not in taken])
    }
    notes = [
        f"{len(names)} {kind} {'file is' if len(names) == 1 else 'files are'} not read and left out: "
        f"{few_names(names, 3)}{_how_to_read(kind)}"
        for kind, names in unread.items()
    ]
    photos = [path for path in islice(_files_below(folder), _MOST_ENTRIES) if is_photo_name(path.name)]
    maps = sorted(
        path.relative_to(folder).as_posix() for path in maps_among(photos) if path.absolute() not in taken
    )
    if maps:
        notes.append(
            f"{len(maps)} pictures are called as maps of photos beside them and are left out: {few_names(maps, 3)}"
        )
    doubles = [
        f"{one.relative_to(folder).as_posix()} ({other.name} is used)"
        for one, other in sorted(doubled(photos).items())
        if one.absolute() not in taken
    ]
    if doubles:
        notes.append(f"{len(doubles)} photos are there in two kinds and count once: {few_names(doubles, 3)}")
    return tuple(notes)


def _how_to_read(kind: str) -> str:
    return f" ({INSTALL})" if any(kind == one.name for one in PHOTO_KINDS) else ""


def unused_image_notes(paths: Sequence[Path], others: Iterable[Path] = ()) -> list[str]:
    """A note on images that lie beside the used ones and are none of ``others`` (masks) either."""
    used = {path.resolve() for path in (*paths, *others)}
    suffixes = {path.suffix.lower() for path in paths}
    unused = []
    for folder in sorted({path.parent.absolute() for path in paths}):
        for path in images_in(folder):
            if path.suffix.lower() in suffixes and path.resolve() not in used:
                unused.append(path.name)
    if not unused:
        return []
    return [
        f"{len(unused)} images beside the used ones have no frame and are left out: {few_names(unused, 3)}"
    ]


def refuse_no_images(files: dict[str, Path], root: Path) -> None:
    """Raises InputError ``no_images`` where there are none, which says what there is instead."""
    if not files:
        raise no_images(root, "there are poses, but no photo")


def _seen(path: Path) -> str:
    """A file's name; for a folder also what kinds of files lie in it."""
    if not path.is_dir():
        return path.name
    kinds = Counter(one.suffix.lower() or "no extension" for one in islice(_files_below(path), _MOST_ENTRIES))
    return f"{path.name}/ ({few_names((f'{n} {kind}' for kind, n in kinds.most_common()), 3) or 'empty'})"


def no_images(root: Path, what: str) -> InputError:
    """The error for a folder in which no photos were found, with what was seen there."""
    folders = list(folders_of_photos(root))
    if folders:
        seen = f"photos lie in {few_names(f'{name}/' for name in folders)}, and which are meant is not clear"
        hint = "Put the photos into images/."
        return InputError("no_images", f"{what} in the usual places: {seen}.", where=str(root), hint=hint)
    kinds = pictures_left_out(root)
    if kinds:
        seen = "; ".join(f"{len(names)} {kind} ({few_names(names, 3)})" for kind, names in kinds.items())
        hint = "Save them as PNG or JPEG, at full size"
        hint += "; from a video, save sharp frames that overlap." if "video" in kinds else "."
        if any(_how_to_read(kind) for kind in kinds):
            hint = f"Run `{INSTALL}`, or save them as PNG or JPEG, at full size."
        return InputError("no_images", f"{what} that is read: {seen}.", where=str(root), hint=hint)
    seen = few_names(map(_seen, visible(root)), 8)
    return InputError(
        "no_images",
        f"{what} that is read: it holds {seen or 'nothing'}.",
        where=str(root),
        hint="Put photos (JPEG, PNG, HEIC, RAW, TIFF) there or into images/, and poses in a form of docs/formats.md.",
    )
