"""Space on local disks: a reserve is kept for running jobs, so that uploads are refused before a disk is full."""

from __future__ import annotations

import errno
import shutil
from collections.abc import Sequence
from pathlib import Path

from workers.settings.errors import LimitReached
from workers.settings.settings import Settings

EXIT_DISK = 5  # of a child process whose disk was full
_ROOM_BYTES = 2**20  # less counts as full: libraries may hide why they could not write


class DiskBudget:
    """The disks of some folders (which need not exist yet); keeps ``reserve_bytes`` free on each."""

    def __init__(self, folders: Sequence[Path], reserve_bytes: int) -> None:
        self._folders, self._reserve_bytes = tuple(folders), reserve_bytes

    def free_bytes(self) -> int:
        """Bytes that may still be written, on the fullest of the disks; not below 0."""
        free = min(shutil.disk_usage(_existing(folder)).free for folder in self._folders)
        return max(0, free - self._reserve_bytes)

    def require(self, more_bytes: int = 0) -> None:
        """Raises `LimitReached` (``storage_full``) if ``more_bytes`` would use up the reserve."""
        free = self.free_bytes()
        if more_bytes > free or not free:
            raise LimitReached("storage_full", "The disk is full but for what running jobs need.")


def upload_disk_budget(settings: Settings) -> DiskBudget:
    """The disks for uploads: where bodies are checked, and the file store if it is a folder."""
    local = [settings.files_dir] if settings.storage_url is None else []
    return DiskBudget([settings.data_dir, *local], settings.disk_reserve_bytes)


def job_disk_budget(settings: Settings) -> DiskBudget:
    """The disk of jobs' working copies."""
    return DiskBudget([settings.scratch_dir], settings.disk_reserve_bytes)


def refused_to_write(error: BaseException) -> bool:
    """Whether the operating system refused to write: disk full, or read-only, as after a fault."""
    return isinstance(error, OSError) and error.errno in {errno.ENOSPC, errno.EDQUOT, errno.EROFS}


def failed_for_room(error: BaseException, folder: Path) -> bool:
    """Whether an error in ``folder`` may have occurred because its disk is full."""
    return refused_to_write(error) or shutil.disk_usage(folder).free < _ROOM_BYTES


def _existing(folder: Path) -> Path:
    while not folder.exists() and folder != folder.parent:
        folder = folder.parent
    return folder
