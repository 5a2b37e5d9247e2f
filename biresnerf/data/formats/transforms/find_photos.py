"""The photos that the frames of a transforms.json name."""

from __future__ import annotations

import posixpath
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial
from pathlib import Path

from biresnerf.data.formats.bad_frames import attempt, good_frames, missing_images
from biresnerf.data.formats.match_names import ENDS, SAME_PATH, Rule, match_files
from biresnerf.data.formats.parsed_poses import FrameCamera, PoseEntry
from biresnerf.data.photos.image_files import ImageHeader, images_called
from biresnerf.data.photos.named_images import lies_in, refuse_outside
from biresnerf.data.photos.photo_folders import COPIES, IMAGE_FOLDER, by_path, few_names, images_below
from biresnerf.errors import InputError

_OF_COPIES: tuple[Rule, ...] = (
    (
        "in a folder of smaller copies",
        lambda name: posixpath.splitext(COPIES.sub(IMAGE_FOLDER, _plain(name).casefold(), count=1))[0],
    ),
)


def find_photos(
    file: Path, root: Path, entries: Sequence[PoseEntry], within: Path | None, *, strict: bool
) -> tuple[list[tuple[Path, PoseEntry]], list[str]]:
    """The entries with the photos that they name, and notes; those whose photo is missing are left out.

    A path is looked for as it is written, relative to the file. If nothing is there: for a path inside the file's
    folder the same in another case or Unicode form; for one that leads out of it, as paths of another machine do, a
    photo of the same end, if one alone has it. Where the file's folder holds no photo at all, the same for every path
    in ``root``, a folder above.

    Args:
        within: look at no path outside of this folder; for uploaded sets.

    Raises:
        InputError: ``frame_without_image``, ``unsafe_path``, ``image_missing`` or ``duplicate_image``.
    """
    outcomes = [attempt(partial(_with_name, entry)) for entry in entries]
    entries, _, nameless = good_frames(outcomes, ["a frame"] * len(entries), strict=strict)
    outside = {entry.name for entry in entries if within is not None and _leads_out(file, entry.name, within)}
    called = {
        entry.name: images_called(file.parent, entry.name) for entry in entries if entry.name not in outside
    }
    found = {name: paths[0] for name, paths in called.items() if paths}
    notes = _find_elsewhere(file, root, [entry.name for entry in entries], found, within)
    several = [f"{path[0].name} (not {path[1].name})" for path in called.values() if len(path) > 1]
    if several:
        notes.append(
            f"{len(several)} names without extension fit several files; taken are {few_names(several, 3)}"
        )
    if outside and not outside & found.keys():
        first = next(entry for entry in entries if entry.name in outside)
        assert within is not None
        for spelling in (first.name, first.name.replace("\\", "/")):
            refuse_outside([file.parent / spelling], [first.name], within, f"{first.where}.file_path")
    missing = [entry for entry in entries if entry.name not in found]
    if missing:
        where, hint = f"{missing[0].where}.file_path", _where(file, missing[0], within)
        notes += missing_images([one.name for one in missing], len(entries), where, hint, strict=strict)
    pairs = [
        (path, _of_copy(path, file, entry))
        for entry in entries
        if (path := found.get(entry.name)) is not None
    ]
    places: dict[str, PoseEntry] = {}
    first_uses = [attempt(partial(_used_once, pair, places)) for pair in pairs]
    once, _, twice = good_frames(first_uses, [entry.name for _, entry in pairs], strict=strict)
    return once, [*nameless, *notes, *twice]


def _where(file: Path, missing: PoseEntry, within: Path | None) -> str:
    """A hint on where the photos may be: some programs keep them in a folder beside the file's."""
    name = posixpath.basename(_plain(missing.name))
    if within is None:
        # No file can have such a name, or the folder may not be read; or nothing is there.
        with suppress(OSError, StopIteration):
            folders = sorted(folder for folder in file.resolve().parent.parent.iterdir() if folder.is_dir())
            beside = next(folder for folder in folders if (folder / name).is_file())
            return f"{name} lies in {beside.name}, beside {file.resolve().parent.name}: give the folder above both."
    return "Put the images there (paths are relative to the file), or remove their frames."


def _plain(name: str) -> str:
    return posixpath.normpath(name.replace("\\", "/"))


def _with_name(entry: PoseEntry) -> PoseEntry:
    if not entry.name:
        raise InputError(
            "frame_without_image",
            "the frame names no image.",
            where=f"{entry.where}.file_path",
            hint="Give the image's path relative to this file, or remove the frame.",
        )
    return entry


def _leads_out(file: Path, name: str, within: Path) -> bool:
    limit = within.resolve()
    return not all(lies_in(file.parent / spelling, limit) for spelling in (name, name.replace("\\", "/")))


def _find_elsewhere(
    file: Path, root: Path, names: Sequence[str], found: dict[str, Path], within: Path | None
) -> list[str]:
    """Adds what other spellings find to ``found``; returns notes."""
    missing = [name for name in names if name not in found]
    if not missing:
        return []
    used = {path.resolve() for path in found.values()}
    limit = None if within is None else within.resolve()
    beside = images_below(file.parent)
    above = not beside and root != file.parent and file.is_relative_to(root)
    files = by_path(root, images_below(root)) if above else by_path(file.parent, beside)
    free = [
        name
        for name, path in files.items()
        if path.resolve() not in used and (limit is None or lies_in(path, limit))
    ]
    far = [name for name in missing if above or _of_another_machine(name)]
    notes = []
    for some, rules in ((far, ENDS), ([name for name in missing if name not in far], SAME_PATH)):
        matched, said = match_files(some, free, rules)
        found |= {name: files[path] for name, path in matched.items()}
        notes += said
    copies = [name for name in free if COPIES.fullmatch(name.split("/")[0])]
    least = min((_times_smaller(name) for name in copies), default=0)
    copies = [name for name in copies if _times_smaller(name) == least]
    matched, said = match_files([name for name in missing if name not in found], copies, _OF_COPIES)
    found |= {name: files[path] for name, path in matched.items()}
    return notes + said


def _times_smaller(path: str) -> int:
    """How many times smaller the photos in such a folder are; 1 in other folders."""
    found = COPIES.fullmatch(path.split("/")[0])
    return int(found[1]) if found else 1


def _of_copy(path: Path, file: Path, entry: PoseEntry) -> PoseEntry:
    """The entry of a photo's smaller copy, whose lens is that of the photo itself where the file names no size."""
    lens, below = entry.lens, path.is_relative_to(file.parent)
    times = _times_smaller(path.relative_to(file.parent).as_posix()) if below else 1
    if times == _times_smaller(_plain(entry.name)) or entry.size != (None, None) or not callable(lens):
        return entry

    def at_full_size(header: ImageHeader, name: str) -> FrameCamera:
        full = lens(header._replace(width=header.width * times, height=header.height * times), name)
        return full._replace(camera=full.camera.resized(header.width, header.height))

    return replace(entry, lens=at_full_size)


def _of_another_machine(name: str) -> bool:
    path = name.replace("\\", "/")
    return path.startswith("/") or path[1:2] == ":" or posixpath.normpath(path).startswith("..")


def _used_once(pair: tuple[Path, PoseEntry], places: dict[str, PoseEntry]) -> tuple[Path, PoseEntry]:
    """``pair``, unless an earlier one in ``places`` has its photo."""
    path, entry = pair
    first = places.setdefault(str(path.resolve()), entry)
    if first is not entry:
        raise InputError(
            "duplicate_image",
            f"{entry.name!r} is the same file as {first.name!r} in {first.where.rpartition(' ')[2]}.",
            where=f"{entry.where}.file_path",
            hint="Remove one of the two frames.",
        )
    return pair
