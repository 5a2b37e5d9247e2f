"""Folders to delete, listed in the transaction that makes them garbage and deleted later by the janitors.

A new folder is listed before its files are stored, and taken off the list in the transaction that records them, so a
process that is killed in between leaves nothing behind.
"""

from __future__ import annotations

import logging
import re

from workers.database.database import Connection, Database
from workers.settings.errors import Unavailable
from workers.store.files import FileStore

log = logging.getLogger(__name__)

FOLDERS_AT_ONCE = 20
# Pause before a retry of a folder that could not be deleted: the store failed, or a file came late.
RETRY_S = 60.0
# The folder of a whole job or dataset, as opposed to a replaced checkpoint.
_WHOLE = re.compile(r"(jobs|datasets)/[^/]+")


async def discard(
    connection: Connection, folder: str, *, after_s: float = 0.0, keep: str | None = None
) -> None:
    """List a folder for deletion after ``after_s``, except its sub-folder named ``keep``."""
    await connection.execute(
        "INSERT INTO trash (prefix, keep, not_before)"
        " VALUES (%s, %s, clock_timestamp() + make_interval(secs => %s))",
        (folder, keep, after_s),
    )


async def rescue(connection: Connection, folder: str) -> None:
    """Take a folder off the list; raises `Unavailable` if it may be deleted already."""
    sql = "DELETE FROM trash WHERE prefix = %s AND not_before > clock_timestamp() RETURNING id"
    if await connection.row(sql, folder) is None:
        raise Unavailable(
            "storage_unavailable", "Storing took too long, and the files may be deleted by now."
        )


async def forget(connection: Connection, folder: str) -> None:
    """Take a folder off the list; it may harmlessly be deleted already."""
    await connection.execute("DELETE FROM trash WHERE prefix = %s", (folder,))


async def delete_unless_rescued(database: Database, files: FileStore, folder: str) -> None:
    """Delete a folder now if it is still listed; if the database is away, a janitor does it later."""
    listed = "UPDATE trash SET not_before = clock_timestamp() WHERE prefix = %s RETURNING id"
    try:
        if await database.fetch(listed, folder):
            await files.delete_prefix(folder)
    except Unavailable as error:
        log.warning("%s is deleted later: %s", folder, error)


async def empty_trash(database: Database, files: FileStore) -> None:
    """Delete the folders that are due, at most 20. Raises `Unavailable`.

    Not in a transaction: deleting a thousand files in a bucket takes long. Safe to run concurrently. Failed deletions
    are retried later, after folders that are due by then.
    """
    for row in await database.fetch(
        # Skips folders that are being rescued.
        "SELECT id, prefix, keep FROM trash WHERE not_before <= clock_timestamp() ORDER BY id LIMIT %s"
        " FOR UPDATE SKIP LOCKED",
        FOLDERS_AT_ONCE,
    ):
        folder = row["prefix"]
        try:
            found, left = await _delete(files, folder, row["keep"])
        except Unavailable:
            await _try_later(database, row["id"])
            raise
        if left:
            log.error("%d files of %s could not be deleted; trying again", left, folder)
            await _try_later(database, row["id"])
            continue
        await database.fetch("DELETE FROM trash WHERE id = %s", row["id"])
        level = logging.INFO if _WHOLE.fullmatch(folder) else logging.DEBUG
        log.log(level, "deleted %s: %d files, %d bytes; none is left", folder, len(found), sum(found))


async def _try_later(database: Database, row_id: int) -> None:
    later = "UPDATE trash SET not_before = clock_timestamp() + make_interval(secs => %s) WHERE id = %s"
    await database.fetch(later, RETRY_S, row_id)


async def _delete(files: FileStore, folder: str, keep: str | None) -> tuple[list[int], int]:
    """Deletes the files; returns their sizes, and how many are left."""
    found = await _sizes(files, folder, keep)
    await files.delete_prefix(folder, keep=keep)
    return found, len(await _sizes(files, folder, keep))


async def _sizes(files: FileStore, folder: str, keep: str | None) -> list[int]:
    """Sizes of the files in a folder, except those in its sub-folder ``keep``."""
    kept = None if keep is None else f"{folder}/{keep}/"
    return [file.size for file in await files.list(folder) if kept is None or not file.key.startswith(kept)]
