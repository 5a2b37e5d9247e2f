"""Space on local disks: a reserve is kept for running jobs, so that uploads are refused before a disk is full."""

from __future__ import annotations

import errno
import shutil
from collections.abc import Sequence
from pathlib import Path

from workers.settings.errors import LimitReached
from workers.settings.settings import Settings

EXIT_DISK = 5  # of a child process that found no room to write
_ROOM_BYTES = 2**20  # a disk with less is full: libraries do not always say why they could not write


class DiskBudget:
    """The disks under some folders (which need not exist yet), of which ``reserve_bytes`` each stay free."""

    def __init__(self, folders: Sequence[Path], reserve_bytes: int) -> None:
        self._folders, self._reserve_bytes = tuple(folders), reserve_bytes

    def free_bytes(self) -> int:
        """Bytes that may still be written, on the fullest of the disks; not below 0."""
        free = min(shutil.disk_usage(_existing(folder)).free for folder in self._folders)
        return max(0, free - self._reserve_bytes)

    def require(self, more_bytes: int = 0) -> None:
        """Raises `LimitReached` (``storage_full``) where ``more_bytes`` would not leave the reserve free."""
        free = self.free_bytes()
        if more_bytes > free or not free:
            raise LimitReached("storage_full", "The disk is full but for what running jobs need.")


def upload_disk_budget(settings: Settings) -> DiskBudget:
    """Where bodies lie while they are checked, and where they end up if that is a folder."""
    local = [settings.files_dir] if settings.storage_url is None else []
    return DiskBudget([settings.data_dir, *local], settings.disk_reserve_bytes)


def job_disk_budget(settings: Settings) -> DiskBudget:
    """Where jobs have their working copies."""
    return DiskBudget([settings.scratch_dir], settings.disk_reserve_bytes)


def refused_to_write(error: BaseException) -> bool:
    """Whether the operating system refused to write: no room, or a disk that became read-only, as after a fault."""
    return isinstance(error, OSError) and error.errno in {errno.ENOSPC, errno.EDQUOT, errno.EROFS}


def failed_for_room(error: BaseException, folder: Path) -> bool:
    """Whether what failed in ``folder`` may have failed because its disk takes no more."""
    return refused_to_write(error) or shutil.disk_usage(folder).free < _ROOM_BYTES


def _existing(folder: Path) -> Path:
    while not folder.exists() and folder != folder.parent:
        folder = folder.parent
    return folder
