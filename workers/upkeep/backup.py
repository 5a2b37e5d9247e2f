"""Makes a backup while the service runs: all files, then a database snapshot and the files added since.

This leaves little time for a running job to replace a checkpoint that the snapshot names.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import shutil
import subprocess
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import psycopg

from biresnerf import __version__
from biresnerf.data.model.atomic_file import whole_file, write_text
from workers.settings.errors import NotFound, SetupError
from workers.settings.settings import Settings
from workers.store.files import FileStore, StoredFile, open_files
from workers.store.store_identity import MARK_KEY
from workers.upkeep.backup_folder import (
    FILES_NAME,
    INDEX_NAME,
    MARKER_NAME,
    TOP_FOLDERS,
    BackupIndex,
    SavedFile,
    connection_of,
    marks,
    path_in,
    postgres_program,
    read_index,
    sha256_of,
)

log = logging.getLogger(__name__)

_NAMED = "SELECT key FROM dataset_files UNION SELECT key FROM job_file_keys"
_STEPS = "SELECT name FROM schema_steps ORDER BY name"


async def make_backup(settings: Settings, url: str, folder: Path) -> BackupIndex:
    """Update the backup in ``folder`` from the database at ``url`` and its files; returns its index.

    ``gone`` of the index lists files deleted during the backup. Raises `SetupError` (also if the folder holds another
    store's backup), `Unavailable` (the store), `OSError` (the folder); the previous backup then stays complete.
    """
    _prepare(folder)
    before = {file.key: file for file in read_index(folder).files} if (folder / INDEX_NAME).exists() else {}
    store = open_files(settings)
    found, ours = await marks(store, folder)
    if ours is not None and found != ours:
        raise SetupError(
            "folder_unusable",
            f"{folder} holds the backup of another installation. Restore it, or name another.",
        )
    saved: dict[str, SavedFile] = {}
    for file in await _stored(store):
        with contextlib.suppress(NotFound):  # deleted after it was listed
            saved[file.key] = await _save(store, file, folder, before.get(file.key))
    async with await psycopg.AsyncConnection.connect(url, connect_timeout=10) as connection:
        await connection.set_isolation_level(psycopg.IsolationLevel.REPEATABLE_READ)
        ((moment,),) = await _rows(connection, "SELECT pg_export_snapshot()")
        made_at = datetime.now(UTC)
        named = {key for (key,) in await _rows(connection, _NAMED)}
        for key in sorted(named - saved.keys()):
            with contextlib.suppress(NotFound):
                saved[key] = await _save(store, await store.head(key), folder, None)
        index = BackupIndex(
            version=__version__,
            made_at=made_at,
            database=f"database-{made_at:%Y%m%dT%H%M%S%f}.dump",
            schema_steps=tuple(name for (name,) in await _rows(connection, _STEPS)),
            files=tuple(saved[key] for key in sorted(saved)),
            gone=tuple(sorted(named - saved.keys())),
        )
        await asyncio.to_thread(_dump, settings, url, folder / index.database, moment)
    write_text(folder / INDEX_NAME, index.model_dump_json(indent=1))
    _prune(folder, index)
    return index


def _dump(settings: Settings, url: str, target: Path, moment: str) -> None:
    """Write the database to ``target``, as the snapshot ``moment`` shows it; raises `SetupError`."""
    leads_there, variables = connection_of(url)
    options = ("--format=custom", "--no-owner", "--no-privileges", "--no-unlogged-table-data")
    command = [postgres_program(settings, "pg_dump"), *options, f"--snapshot={moment}", f"--file={target}"]
    ended = subprocess.run([*command, leads_there], env=variables, capture_output=True, text=True)
    if ended.returncode != 0:
        raise SetupError("pg_dump_failed", f"pg_dump failed: {ended.stderr.strip()[-1500:]}")


async def _rows(connection: psycopg.AsyncConnection, sql: str) -> list[tuple[Any, ...]]:
    return await (await connection.execute(sql.encode())).fetchall()


def _prepare(folder: Path) -> None:
    """Create the folder, readable by its owner alone: a backup holds all the service's data.

    An existing folder must be a backup's: files that a backup does not know are deleted from it.
    """
    marker = folder / MARKER_NAME
    if folder.exists() and any(folder.iterdir()) and not marker.exists():
        raise SetupError("folder_unusable", f"{folder} holds something that is no backup. Name an empty one.")
    folder.mkdir(parents=True, exist_ok=True)
    folder.chmod(0o700)
    marker.touch()
    (folder / FILES_NAME).mkdir(exist_ok=True)


async def _stored(store: FileStore) -> list[StoredFile]:
    found = [file for top in TOP_FOLDERS for file in await store.list(top)]
    try:
        found.append(await store.head(MARK_KEY))
    except NotFound:
        log.warning("the file store has no identity file; is this the one the service uses?")
    return found


async def _save(store: FileStore, file: StoredFile, folder: Path, before: SavedFile | None) -> SavedFile:
    path = path_in(folder, file.key)
    known = before is not None and (before.size, before.etag) == (file.size, file.etag)
    if before is not None and known and path.is_file() and path.stat().st_size == file.size:
        return before
    with whole_file(path) as partial, partial.open("wb") as out:
        async for chunk in store.read(file.key):
            await asyncio.to_thread(out.write, chunk)
    digest = await asyncio.to_thread(sha256_of, path)
    return SavedFile(key=file.key, size=path.stat().st_size, sha256=digest, etag=file.etag)


def _prune(folder: Path, index: BackupIndex) -> None:
    """Delete older dumps, and files that the service has deleted."""
    keep = {path_in(folder, file.key) for file in index.files}
    root = folder / FILES_NAME
    for path in sorted(root.rglob("*"), reverse=True):
        if path.is_dir() and not path.is_symlink():
            if not any(path.iterdir()):
                shutil.rmtree(path)
        elif path not in keep:
            path.unlink()
    for dump in folder.glob("database-*.dump"):
        if dump.name != index.database:
            dump.unlink()
