"""Uploaded sets: every file they name must lie inside their own folder, links included."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from biresnerf.errors import InputError


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
