"""Puts a backup into an empty installation: files first, then the database in one transaction."""

from __future__ import annotations

import asyncio
import contextlib
import subprocess
import tempfile
from pathlib import Path

import psycopg

from biresnerf.errors import InputError
from workers.database.migrate import migrate
from workers.jobs.job_expiry import FORGET_CHECKPOINTS
from workers.settings.errors import SetupError
from workers.settings.settings import Settings
from workers.store.files import FileStore, open_files
from workers.upkeep.backup_folder import (
    BackupIndex,
    connection_of,
    marks,
    path_in,
    postgres_program,
    read_index,
)

_TIMEOUT = b"SET transaction_timeout = 0;\n"
_TIMEOUT_OF_ANY = (
    b"SELECT set_config(name, '0', false) FROM pg_settings WHERE name = 'transaction_timeout';\n"
)


async def restore_backup(settings: Settings, url: str, folder: Path) -> BackupIndex:
    """Put the backup in ``folder`` into the empty database at ``url`` and the file store of the settings.

    Every file is checked against its digest. A backup of an older version is migrated. If it fails, it can be repeated.
    Raises `SetupError` (no whole backup, a database that is not empty, damaged files), `Unavailable` (the store).
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
    await asyncio.to_thread(_restore_database, settings, url, folder / index.database)
    migrate(url)
    _forget_lost_checkpoints(url, index)
    return index


def _restore_database(settings: Settings, url: str, dump: Path) -> None:
    """Run the dump's SQL in one transaction; raises `SetupError` and leaves the database unchanged.

    pg_restore alone fails on servers before 17: it sends `_TIMEOUT` to any version.
    """
    making = [
        postgres_program(settings, "pg_restore"),
        "--file=-",
        "--no-owner",
        "--no-privileges",
        str(dump),
    ]
    leads_there, variables = connection_of(url)
    running = [
        postgres_program(settings, "psql"),
        "--no-psqlrc",
        "--quiet",
        "--set=ON_ERROR_STOP=1",
        leads_there,
    ]
    with (
        tempfile.TemporaryFile() as said,
        subprocess.Popen(making, stdout=subprocess.PIPE, stderr=said) as made,
        subprocess.Popen(
            running, stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, stderr=said, env=variables
        ) as run,
    ):
        assert made.stdout is not None
        assert run.stdin is not None
        with contextlib.suppress(BrokenPipeError):  # psql has ended, with an error message
            run.stdin.write(b"BEGIN;\n")
            run.stdin.writelines(_TIMEOUT_OF_ANY if line == _TIMEOUT else line for line in made.stdout)
            if made.wait() == 0:
                run.stdin.write(b"COMMIT;\n")
        made.stdout.close()
        run.communicate()
        said.seek(0)
        if made.wait() != 0 or run.returncode != 0:
            why = said.read().decode(errors="replace").strip()
            ends = f"pg_restore ended with {made.returncode}, psql with {run.returncode}"
            raise SetupError("pg_restore_failed", f"The dump cannot be restored ({ends}): {why[:1500]}")


def _forget_lost_checkpoints(url: str, index: BackupIndex) -> None:
    """Make jobs start over whose checkpoints were replaced during the backup."""
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
    """Require a new store, or one with this backup's mark, from an earlier restore."""
    found, ours = await marks(store, folder)
    if found is not None and ours is not None and found != ours:
        raise SetupError(
            "store_not_empty", "The file store belongs to another installation. Use an empty one."
        )


async def _put_back(store: FileStore, folder: Path, key: str, sha256: str) -> bool:
    try:
        await store.put_path(key, path_in(folder, key), expected_sha256=sha256)
    except (InputError, FileNotFoundError):
        return False
    return True
