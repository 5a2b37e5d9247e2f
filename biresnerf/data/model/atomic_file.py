"""Files that appear whole or not at all."""

from __future__ import annotations

import json
import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any


@contextmanager
def whole_file(path: Path) -> Iterator[Path]:
    """A path beside ``path`` to write to; on success it takes ``path``'s place, else it is removed."""
    path.parent.mkdir(parents=True, exist_ok=True)
    # The suffix is kept at the end: image and video writers choose their format by it.
    handle, name = tempfile.mkstemp(prefix=f".{path.stem}.", suffix=path.suffix, dir=path.parent)
    os.close(handle)
    temporary = Path(name)
    try:
        yield temporary
        # mkstemp's 0600 would hide results from the group that the folder is shared with.
        temporary.chmod(0o666 & ~_umask())
        with temporary.open("rb") as written:
            os.fsync(written.fileno())
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)


def write_text(path: Path, text: str) -> None:
    """Write a text and a line feed in UTF-8, whole or not at all."""
    with whole_file(path) as temporary:
        temporary.write_text(text + "\n", "utf-8")


def write_json(path: Path, document: Any, indent: int = 2) -> None:
    """Write a JSON document, whole or not at all. Raises ValueError for NaN and infinity."""
    write_text(path, json.dumps(document, indent=indent, ensure_ascii=False, allow_nan=False))


def _umask() -> int:
    """The process's umask, read without changing it (Linux), else the usual one."""
    try:
        for line in Path("/proc/self/status").read_text().splitlines():
            if line.startswith("Umask:"):
                return int(line.split()[1], 8)
    except OSError:
        pass
    return 0o022
