"""A backup on disk: a database dump, a copy of every file, and an index of both.

``backup.json`` is written last and replaced atomically, so a folder holds one complete backup or none. Files never
change under their key, so the next backup into the folder copies only new ones.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
from datetime import datetime
from pathlib import Path
from typing import Any

from psycopg.conninfo import conninfo_to_dict, make_conninfo
from pydantic import ValidationError

from biresnerf.wire.base import Record
from workers.database.postgres_binaries import find_binaries
from workers.settings.errors import NotFound, SetupError
from workers.settings.settings import Settings
from workers.store.files import FileStore
from workers.store.store_identity import MARK_KEY

MARKER_NAME = "biresnerf-backup"
INDEX_NAME = "backup.json"
FILES_NAME = "files"
TOP_FOLDERS = ("datasets", "jobs")


class SavedFile(Record):
    """One file of a backup, by its key in the store."""

    key: str
    size: int
    sha256: str
    etag: str


class BackupIndex(Record):
    """The index of one complete backup."""

    version: str
    made_at: datetime
    database: str
    schema_steps: tuple[str, ...]
    files: tuple[SavedFile, ...]
    gone: tuple[str, ...] = ()

    @property
    def bytes(self) -> int:
        """Size of all files."""
        return sum(file.size for file in self.files)


def read_index(folder: Path) -> BackupIndex:
    """The index of the backup in ``folder``; raises `SetupError` if there is no complete one."""
    try:
        return BackupIndex.model_validate_json((folder / INDEX_NAME).read_bytes())
    except (OSError, ValidationError) as error:
        raise SetupError("no_backup", f"{folder} holds no whole backup ({error}).") from error


def path_in(folder: Path, key: str) -> Path:
    """The path of a stored file in the backup; raises `SetupError` for a key that leads out of it."""
    parts = key.split("/")
    if any(part in ("", ".", "..") or "\0" in part for part in parts):
        raise SetupError("no_backup", f"The backup in {folder} names the file {key!r}.")
    return folder.joinpath(FILES_NAME, *parts)


async def marks(store: FileStore, folder: Path) -> tuple[bytes | None, bytes | None]:
    """The marks of the store and of the backup, which identify their database; None if not set yet."""
    found = ours = None
    with contextlib.suppress(NotFound):
        found = b"".join([chunk async for chunk in store.read(MARK_KEY)])
    with contextlib.suppress(FileNotFoundError):
        ours = path_in(folder, MARK_KEY).read_bytes()
    return found, ours


def sha256_of(path: Path) -> str:
    """Digest of a local file."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def postgres_program(settings: Settings, name: str) -> str:
    """Path of ``pg_dump``, ``pg_restore`` or ``psql``; raises `SetupError` if there is none."""
    program = find_binaries(settings.pg_bin) / name
    if not program.is_file():
        raise SetupError(
            "no_pg_dump", f"There is no {program}. Set BIRESNERF_PG_BIN to a folder that has it."
        )
    return str(program)


def connection_of(url: str) -> tuple[str, dict[str, str]]:
    """The option with which such a program connects to the database at ``url``, and its environment.

    The password is not on the command line, which every user of the machine can read.
    """
    parts: dict[str, Any] = conninfo_to_dict(url)
    password = parts.pop("password", None)
    variables = {} if password is None else {"PGPASSWORD": str(password)}
    return f"--dbname={make_conninfo(**parts)}", {**os.environ, **variables}
