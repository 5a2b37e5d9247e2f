"""Ensures that all processes of an installation see the same files: database and store share a mark.

So a second host with its own folder, or a wrong bucket, is noticed at the start and not when a job misses its images.
"""

from __future__ import annotations

import uuid

from workers.database.database import Database
from workers.settings.errors import NotFound, SetupError, Unavailable
from workers.store.files import FileStore

MARK_KEY = "store-id"
MARK_LOCK = 7_201_640
MARK_BYTES = 64


async def require_same_store(database: Database, files: FileStore) -> None:
    """Marks a new pair of database and store; raises `SetupError` if the marks differ, or one is away."""
    try:
        async with database.transaction() as connection:
            await connection.execute("SELECT pg_advisory_xact_lock(%s)", (MARK_LOCK,))
            row = await connection.row("SELECT id FROM file_store")
            known, found = None if row is None else row["id"], await _mark(files)
            if found is None and known is None:
                found = known = uuid.uuid4().hex
                await files.put_bytes(MARK_KEY, known.encode())
                await connection.execute("INSERT INTO file_store (id) VALUES (%s)", (known,))
            elif known is None:
                # An existing store with a new database: a restore, or a second schema. Keys never collide.
                await connection.execute("INSERT INTO file_store (id) VALUES (%s)", (found,))
                known = found
    except Unavailable as error:
        raise SetupError("storage_unusable", f"The start needs database and files. {error.detail}") from error
    if found != known:
        raise SetupError(
            "storage_of_another",
            f"The files that this process sees are not those of its database (mark {found}, expected {known}). "
            "Workers and API on several machines need one store: BIRESNERF_STORAGE_URL=s3://…, or one shared "
            "folder as BIRESNERF_DATA_DIR/files. If the files were moved here on purpose, write the expected "
            f"mark into the file {MARK_KEY} there.",
        )


async def _mark(files: FileStore) -> str | None:
    try:
        content = b"".join([chunk async for chunk in files.read(MARK_KEY, 0, MARK_BYTES)])
    except NotFound:
        return None
    return content.decode(errors="replace").strip()
