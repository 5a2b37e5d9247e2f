"""Images that a file names: found beside it, each once, inside the folder where that is asked; few are refused."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path

from biresnerf.data.model.safe_names import refuse_outside
from biresnerf.data.photos.image_files import find_image, is_image_name
from biresnerf.errors import InputError

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


def refuse_names_outside(file: Path, names: Sequence[str], within: Path, field: str) -> None:
    """Names in ``file`` that lead out of ``within`` are refused before anything is looked for there.

    Raises:
        InputError: ``unsafe_path``; links are followed, and both kinds of slashes are.
    """
    for index, name in enumerate(names):
        for spelling in (name, name.replace("\\", "/")):
            refuse_outside([file.parent / spelling], [name], within, f"{file.name} frames[{index}].{field}")


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
