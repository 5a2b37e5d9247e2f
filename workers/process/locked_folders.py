"""Work folders of living processes, deleted with them. No process deletes one that is in use."""

from __future__ import annotations

import asyncio
import contextlib
import fcntl
import shutil
import tempfile
import time
from collections.abc import AsyncIterator
from pathlib import Path

IN_USE = ".in-use"
SETTLED_S = 1.0  # a younger folder may not be locked yet


@contextlib.asynccontextmanager
async def locked_folder(parent: Path) -> AsyncIterator[Path]:
    """A private folder, deleted at the end of the block or, after a crash, by `sweep_folders`."""
    parent.mkdir(parents=True, exist_ok=True)
    folder = Path(tempfile.mkdtemp(dir=parent))
    try:
        with (folder / IN_USE).open("wb") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)  # the kernel releases it, however we die
            yield folder
    finally:
        await asyncio.to_thread(shutil.rmtree, folder, ignore_errors=True)


def sweep_folders(parent: Path) -> int:
    """Removes folders of dead processes, which no longer hold the lock; returns how many."""
    removed = 0
    for folder in parent.iterdir() if parent.is_dir() else ():
        with contextlib.suppress(OSError):  # deleted meanwhile
            if time.time() - folder.stat().st_mtime >= SETTLED_S and not _in_use(folder):
                shutil.rmtree(folder, ignore_errors=True)
                removed += 1
    return removed


def _in_use(folder: Path) -> bool:
    try:
        with (folder / IN_USE).open("rb") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    except FileNotFoundError:
        pass  # partly deleted
    return False
