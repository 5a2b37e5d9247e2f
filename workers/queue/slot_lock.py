"""Slot names, each unique on its host while a process holds it."""

from __future__ import annotations

import fcntl
import platform
import re
from itertools import count
from pathlib import Path
from typing import IO, Literal

from workers.settings.errors import SetupError

HOST = platform.node() or "localhost"


class SlotLock:
    """Makes a slot name unique on this host and remembers the queue id of who held it last."""

    def __init__(self, data_dir: Path, name: str) -> None:
        """Take the lock; raises `SetupError` (``bad_slot_name``; ``slot_taken`` where another process holds it)."""
        if not re.fullmatch(r"[A-Za-z0-9_-]{1,40}", name):
            raise SetupError("bad_slot_name", f"--slot {name!r}: letters, digits, - and _ only, at most 40.")
        self.name = name
        folder = data_dir / "slots"
        folder.mkdir(parents=True, exist_ok=True)
        path = folder / f"{HOST}.{name}"
        self._file: IO[str] = path.open("a+")
        try:
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)  # freed by the kernel, however we die
        except BlockingIOError:
            self._file.close()
            raise SetupError(
                "slot_taken", f"Slot {name} runs already on this machine; give this one another --slot."
            ) from None
        self._file.seek(0)
        text = self._file.read().strip()
        self.predecessor = int(text) if text.isdigit() else None

    def remember(self, worker_id: int) -> None:
        """Write down our id for our successor."""
        self._file.truncate(0)
        self._file.write(str(worker_id))
        self._file.flush()


def lock_free_slot(data_dir: Path, kind: Literal["cpu", "gpu"]) -> SlotLock:
    """The first free one of ``cpu0``, ``cpu1`` …: workers that come and go leave no more names than run at once."""
    for number in count():
        try:
            return SlotLock(data_dir, f"{kind}{number}")
        except SetupError as taken:
            if taken.code != "slot_taken":
                raise
    raise AssertionError("numbers do not end")
