"""Puts a backup into an empty installation: files first, then the database in one transaction."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from pathlib import Path

import psycopg

from biresnerf.errors import InputError
from workers.database.migrate import migrate
from workers.jobs.job_expiry import FORGET_CHECKPOINTS
from workers.settings.errors import NotFound, SetupError
from workers.settings.settings import Settings
from workers.store.files import CHUNK_BYTES, FileStore, open_files
from workers.store.store_identity import MARK_KEY
from workers.upkeep.backup_folder import BackupIndex, path_in, read_index, run_postgres_program


async def restore_backup(settings: Settings, url: str, folder: Path) -> BackupIndex:
    """Put the backup in ``folder`` into the empty database at ``url`` and the file store of the settings.

    Every file is checked against its digest on the way. A backup of an older version is brought up to date.
    Where it stops, it may be begun again. Raises `SetupError` (no whole backup, a database that is not empty,
    damaged files), `Unavailable` (the store).
    """
    index = read_index(folder)
    _require_empty(url)
    store = open_files(settings)
    await _require_own_store(store, folder)
    damaged = [file.key for file in index.files if not await _put_back(store, folder, file.key, file.sha256)]
    if damaged:
        raise SetupError(
            "backup_damaged", f"{len(damaged)} files of the backup are damaged or missing: {damaged[:5]}."
        )
    await asyncio.to_thread(
        run_postgres_program,
        settings,
        url,
        "pg_restore",
        *("--single-transaction", "--exit-on-error", "--no-owner", "--no-privileges"),
        str(folder / index.database),
    )
    migrate(url)
    _forget_lost_checkpoints(url, index)
    return index


def _forget_lost_checkpoints(url: str, index: BackupIndex) -> None:
    """A job whose checkpoint was replaced while the backup was made starts over."""
    lost = list({key.rpartition("/")[0] for key in index.gone})
    with psycopg.connect(url, connect_timeout=10) as connection:
        connection.execute(FORGET_CHECKPOINTS, (lost,))


def _require_empty(url: str) -> None:
    with psycopg.connect(url, connect_timeout=10) as connection:
        row = connection.execute("SELECT to_regclass('jobs'), to_regclass('queue_entries')").fetchone()
    if row is None or any(row):
        raise SetupError(
            "database_not_empty",
            "The database holds an installation already. Restore into an empty one: "
            "a fresh BIRESNERF_DATA_DIR, or a new database in BIRESNERF_DATABASE_URL.",
        )


async def _require_own_store(store: FileStore, folder: Path) -> None:
    """The store must be new, or hold what a restore of this backup began; its mark tells."""
    try:
        found = b"".join([chunk async for chunk in store.read(MARK_KEY)])
        ours = path_in(folder, MARK_KEY).read_bytes()
    except (NotFound, FileNotFoundError):
        return
    if found != ours:
        raise SetupError(
            "store_not_empty", "The file store belongs to another installation. Use an empty one."
        )


async def _put_back(store: FileStore, folder: Path, key: str, sha256: str) -> bool:
    try:
        await store.put(key, _chunks(path_in(folder, key)), limit_bytes=2**62, expected_sha256=sha256)
    except (InputError, FileNotFoundError):
        return False
    return True


async def _chunks(path: Path) -> AsyncIterator[bytes]:
    with path.open("rb") as file:
        while chunk := await asyncio.to_thread(file.read, CHUNK_BYTES):
            yield chunk
