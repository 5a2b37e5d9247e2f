"""Images that a file names: found beside it, each once, inside the folder where that is asked; few are refused."""

from __future__ import annotations

import os
from collections.abc import Iterable, Sequence
from pathlib import Path

from biresnerf.data.photos.image_files import find_image, is_image_name
from biresnerf.errors import InputError

IMAGE_FOLDER = "images"
# Folders beside the poses whose pictures are not the set's photos; `biresnerf convert` writes pinhole/.
_NO_PHOTOS = frozenset({"masks", "depth", "pinhole"})
MIN_IMAGES = 3  # two views leave scale and much else open


def few_names(names: Iterable[str], limit: int = 5) -> str:
    """A short list for a message: the first ``limit`` names and how many more."""
    listed = list(names)
    more = f" and {len(listed) - limit} more" if len(listed) > limit else ""
    return ", ".join(listed[:limit]) + more


def refuse_too_few(count: int, where: str) -> None:
    """Raises InputError ``too_few_images`` where ``count`` images are too few to optimise anything."""
    if count < MIN_IMAGES:
        raise InputError(
            "too_few_images",
            f"{count} image{'' if count == 1 else 's'}; at least {MIN_IMAGES} are needed.",
            where=where,
            hint="Add views that overlap; 20 to 100 are good.",
        )


def lies_in(path: Path, limit: Path) -> bool:
    """Whether ``path`` leads into the folder ``limit``, which is resolved."""
    try:
        return path.resolve().is_relative_to(limit)
    except (OSError, ValueError):  # too long, or a NUL in it: no such file anyway
        return False


def refuse_outside(paths: Sequence[Path], names: Sequence[str], within: Path, where: str) -> None:
    """Raises InputError ``unsafe_path`` for the first of ``paths`` that lies outside of the folder ``within``."""
    limit = within.resolve()
    for path, name in zip(paths, names, strict=True):
        if not lies_in(path, limit):
            raise InputError(
                "unsafe_path",
                f"{name[:100]!r} leads out of the image set's folder.",
                where=where,
                hint="Name images by their path relative to this file, inside the folder.",
            )


def refuse_names_outside(file: Path, names: Sequence[str], within: Path, field: str) -> None:
    """Names in ``file`` that lead out of ``within`` are refused before anything is looked for there.

    Raises:
        InputError: ``unsafe_path``; links are followed, and both kinds of slashes are.
    """
    for index, name in enumerate(names):
        for spelling in (name, name.replace("\\", "/")):
            refuse_outside([file.parent / spelling], [name], within, f"{file.name} frames[{index}].{field}")


def refuse_more_than_files(file: Path, names: Sequence[str], within: Path) -> None:
    """Raises InputError ``image_missing`` where ``within`` has fewer files than there are frames, each with its own.

    Looking for each would take a while, with a hundred thousand frames a minute.
    """
    files = sum(len(found) for _, _, found in os.walk(within))
    if len(names) > files:
        raise InputError(
            "image_missing",
            f"{len(names)} frames, but the set has only {files} files.",
            where=f"{file.name} frames",
            hint="Put an image there for each frame (paths are relative to the file), or remove frames.",
        )


def find_images(file: Path, names: Sequence[str]) -> list[Path]:
    """The images that the frames of ``file`` name.

    Raises:
        InputError: ``image_missing`` or ``duplicate_image``.
    """
    found = [find_image(file.parent, name) for name in names]
    missing = [index for index, image in enumerate(found) if image is None]
    if missing:
        raise InputError(
            "image_missing",
            f"{len(missing)} of {len(names)} images not found: {few_names(names[i] for i in missing)}.",
            where=f"{file.name} frames[{missing[0]}].file_path",
            hint="Put the images there (paths are relative to the file), or remove their frames.",
        )
    images = [image for image in found if image is not None]
    places: dict[str, int] = {}
    for index, image in enumerate(images):
        first = places.setdefault(str(image.resolve()), index)
        if first != index:
            raise InputError(
                "duplicate_image",
                f"{names[index]!r} is the same file as {names[first]!r} in frames[{first}].",
                where=f"{file.name} frames[{index}].file_path",
                hint="Remove one of the two frames.",
            )
    return images


def unused_image_notes(paths: Sequence[Path], others: Iterable[Path] = ()) -> list[str]:
    """A note on images that lie beside the used ones and are none of ``others`` (masks) either."""
    used = {path.resolve() for path in (*paths, *others)}
    suffixes = {path.suffix.lower() for path in paths}
    unused = []
    for folder in sorted({path.parent.resolve() for path in paths}):
        for path in sorted(folder.iterdir()):
            image = path.suffix.lower() in suffixes and is_image_name(path)
            if image and path not in used and path.is_file():
                unused.append(path.name)
    if not unused:
        return []
    return [
        f"{len(unused)} images beside the used ones have no frame and are left out: {few_names(unused, 3)}"
    ]


def photos_beside(root: Path) -> dict[str, Path]:
    """The images beside poses that do not say where theirs are, by path with forward slashes; perhaps none.

    Those of `images_beside`, else those in the one other folder of ``root`` that has images (rgb/ of TUM's sets,
    train/ of NeRF-synthetic ones), by their path in ``root``.
    """
    return images_beside(root) or _images_of_only_folder(root)


def _images_of_only_folder(root: Path) -> dict[str, Path]:
    folders = [path for path in visible(root) if path.is_dir() and path.name not in _NO_PHOTOS]
    found = [paths for paths in map(images_below, folders) if paths]
    return {path.relative_to(root).as_posix(): path for path in found[0]} if len(found) == 1 else {}


def refuse_no_images(files: dict[str, Path], root: Path) -> None:
    """Raises InputError ``no_images`` where there are none."""
    if not files:
        raise InputError(
            "no_images",
            "there are poses, but no images.",
            where=str(root),
            hint="Put the images into images/ beside the poses.",
        )


def images_beside(root: Path) -> dict[str, Path]:
    """The images in ``root``/images, else in ``root``, by their path there; empty where there are none."""
    folder = root / IMAGE_FOLDER
    paths = images_below(folder)
    if not paths:
        folder, paths = root, images_in(root)
    return {path.relative_to(folder).as_posix(): path for path in paths}


def visible(folder: Path) -> list[Path]:
    """What a folder holds but hidden files, sorted. Raises InputError ``input_unreadable``."""
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
    """The images in ``folder`` itself, sorted; instant-ngp's masks are none."""
    return [path for path in visible(folder) if _is_image(path.name) and path.is_file()]


def images_below(folder: Path) -> list[Path]:
    """The images in ``folder`` and its folders, sorted; instant-ngp's masks are none."""
    found = []
    for parent, folders, files in os.walk(folder):
        folders[:] = [name for name in folders if not name.startswith(".")]
        found += [Path(parent, name) for name in files if _is_image(name)]
    return sorted(found)


def _is_image(name: str) -> bool:
    return not name.startswith((".", "dynamic_mask_")) and is_image_name(Path(name))
