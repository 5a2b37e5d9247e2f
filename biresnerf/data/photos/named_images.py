"""Checks of the images that a file names: inside the required folder, and not too few."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

from biresnerf.errors import InputError

MIN_IMAGES = 3  # two views leave scale and much else open


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


def refuse_more_than_files(where: str, frames: int, within: Path) -> None:
    """Raises InputError ``image_missing`` where ``within`` has too few files for most of the frames to have their own.

    Looking for each would take a while, with a hundred thousand frames a minute.
    """
    files = sum(len(found) for _, _, found in os.walk(within))
    if frames > 2 * files:
        raise InputError(
            "image_missing",
            f"{frames} frames, but the set has only {files} files.",
            where=where,
            hint="Put an image there for each frame (paths are relative to the file), or remove frames.",
        )
