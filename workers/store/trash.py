"""Takes the trash out: deletes the files that nothing points at any more, and says that they are gone."""

from __future__ import annotations

import logging
import re

from workers.database.database import Database
from workers.store.files import FileStore

log = logging.getLogger(__name__)

BATCH = 20
# What did not go (a store that answered with an error, a file that came late) is tried again.
AGAIN_S = 60.0
# A whole job or dataset, as opposed to a checkpoint that was replaced.
_WHOLE = re.compile(r"(jobs|datasets)/[^/]+")


async def take_trash_out(database: Database, files: FileStore) -> None:
    """Delete what is due, at most 20 folders. Raises `Unavailable`.

    Outside of a transaction: a thousand files in a bucket take their time. Two of us do no harm.
    """
    for row in await database.fetch(
        "SELECT id, prefix, keep FROM trash WHERE not_before <= clock_timestamp() ORDER BY id LIMIT %s", BATCH
    ):
        prefix, keep = row["prefix"], row["keep"]
        doomed = await _below(files, prefix, keep)
        await files.delete_prefix(prefix, keep=keep)
        left = await _below(files, prefix, keep)
        if left:
            log.error("%d files of %s could not be deleted; trying again", len(left), prefix)
            await database.fetch(
                "UPDATE trash SET not_before = clock_timestamp() + make_interval(secs => %s) WHERE id = %s",
                *(AGAIN_S, row["id"]),
            )
            continue
        await database.fetch("DELETE FROM trash WHERE id = %s", row["id"])
        level = logging.INFO if _WHOLE.fullmatch(prefix) else logging.DEBUG
        log.log(level, "deleted %s: %d files, %d bytes; none is left", prefix, len(doomed), sum(doomed))


async def _below(files: FileStore, prefix: str, keep: str | None) -> list[int]:
    """Sizes of the files in a folder, less those in its sub-folder ``keep``."""
    kept = None if keep is None else f"{prefix}/{keep}/"
    return [file.size for file in await files.list(prefix) if kept is None or not file.key.startswith(kept)]
