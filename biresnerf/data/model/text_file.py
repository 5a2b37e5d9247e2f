"""Files of unknown origin: bounded in size, text in UTF-8, numbers finite."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from biresnerf.errors import InputError

MAX_TEXT_BYTES = 64 * 2**20


def read_bytes(path: Path, most_bytes: int) -> bytes:
    """The content of ``path``. Raises InputError ``pose_file_invalid`` where it is longer than ``most_bytes``."""
    try:
        size = path.stat().st_size
        if size > most_bytes:
            what = f"{size / 2**20:.0f} MiB is more than a pose file may have ({most_bytes // 2**20} MiB)."
            raise invalid_file(path.name, what, "Leave out what does not describe cameras, or split the set.")
        return path.read_bytes()
    except OSError as error:
        what = f"cannot be read: {error.strerror}."
        raise invalid_file(path.name, what, "Check the path and its permissions.") from None


def read_text(path: Path, most_bytes: int = MAX_TEXT_BYTES) -> str:
    """The text of ``path``. Raises InputError ``pose_file_invalid`` where it is none, or longer than ``most_bytes``."""
    try:
        return read_bytes(path, most_bytes).decode("utf-8-sig")
    except UnicodeDecodeError:
        hint = "Save it in UTF-8, or export it again."
        raise invalid_file(path.name, "is not UTF-8 text.", hint) from None


def finite_numbers(words: Sequence[str], where: str, hint: str) -> NDArray[np.float64]:
    """The numbers that ``words`` stand for. Raises InputError ``pose_file_invalid`` or ``pose_not_finite``."""
    try:
        values = np.array([float(word) for word in words], dtype=np.float64)
    except ValueError:
        raise invalid_file(where, "holds a word that is no number.", hint) from None
    if not np.isfinite(values).all():
        raise InputError("pose_not_finite", "NaN or an infinite number.", where=where, hint=hint)
    return values


def invalid_file(where: str, what: str, hint: str) -> InputError:
    """The error for a pose file of which ``what`` is wrong at ``where``."""
    return InputError("pose_file_invalid", what, where=where, hint=hint)
