"""Files and folders that appear whole or not at all."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from secrets import token_hex
from typing import Any


@contextmanager
def whole_file(path: Path) -> Iterator[Path]:
    """A path beside ``path`` to write to; on success it takes ``path``'s place, else it is removed."""
    path.parent.mkdir(parents=True, exist_ok=True)
    # The suffix is kept at the end: image and video writers choose their format by it.
    temporary = path.with_name(f".{path.stem}.{token_hex(6)}{path.suffix}")
    temporary.touch(exist_ok=False)  # unlike mkstemp's, open to the group that the folder is shared with
    try:
        yield temporary
        with temporary.open("rb") as written:
            os.fsync(written.fileno())
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)


@contextmanager
def whole_folder(folder: Path) -> Iterator[Path]:
    """A folder beside ``folder`` (new, or empty) to write to, which takes its place at the end; else it goes."""
    staging = folder.with_name(f".{folder.name}.{token_hex(6)}")
    staging.mkdir(parents=True)
    try:
        yield staging
        staging.replace(folder)
    finally:
        shutil.rmtree(staging, ignore_errors=True)


def write_text(path: Path, text: str) -> None:
    """Write a text and a line feed in UTF-8, whole or not at all."""
    with whole_file(path) as temporary:
        temporary.write_text(text + "\n", "utf-8")


def write_json(path: Path, document: Any, indent: int = 2) -> None:
    """Write a JSON document, whole or not at all. Raises ValueError for NaN and infinity."""
    write_text(path, json.dumps(document, indent=indent, ensure_ascii=False, allow_nan=False))
