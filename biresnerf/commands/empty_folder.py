"""The check that a folder for results is empty."""

from __future__ import annotations

from pathlib import Path

from biresnerf.errors import InputError


def require_empty(folder: Path) -> None:
    """Raises `InputError` ``output_not_empty`` unless the folder is empty or does not exist."""
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise InputError(
            "output_not_empty", "is not an empty folder.", where=str(folder), hint="Name a new folder."
        )
