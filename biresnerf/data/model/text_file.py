"""Text files of unknown origin: bounded in size, UTF-8."""

from __future__ import annotations

from pathlib import Path

from biresnerf.errors import InputError

MAX_TEXT_BYTES = 64 * 2**20


def read_text(path: Path, most_bytes: int = MAX_TEXT_BYTES) -> str:
    """The text of ``path``. Raises InputError ``pose_file_invalid`` where it is none, or longer than ``most_bytes``."""

    def invalid(what: str, hint: str) -> InputError:
        return InputError("pose_file_invalid", what, where=path.name, hint=hint)

    try:
        size = path.stat().st_size
        if size > most_bytes:
            what = f"{size / 2**20:.0f} MiB is more than a pose file may have ({most_bytes // 2**20} MiB)."
            raise invalid(what, "Leave out what does not describe cameras, or split the set.")
        return path.read_text(encoding="utf-8-sig")
    except OSError as error:
        raise invalid(f"cannot be read: {error.strerror}.", "Check the path and its permissions.") from None
    except UnicodeDecodeError:
        raise invalid("is not UTF-8 text.", "Save it in UTF-8, or export it again.") from None
