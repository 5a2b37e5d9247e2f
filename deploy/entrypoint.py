"""Copies the image's compiled kernels to where Numba can add to them, then executes the command.

On another kind of CPU than the image's, Numba compiles its own kernels beside them.
"""

from __future__ import annotations

import filecmp
import os
import shutil
import sys
from pathlib import Path

IMAGE = Path("/opt/kernels")
USES_KERNELS = {"worker", "up", "demo", "refine"}


def place_kernels(image: Path, folder: Path) -> None:
    """Copy the image's kernels to ``folder``, unless it has them."""
    made_from = folder / "made-from"
    if made_from.exists() and filecmp.cmp(image / "made-from", made_from, shallow=False):
        return
    # Replaced atomically: another container may use the same volume or start on it.
    fresh = folder.with_name(f"{folder.name}.{os.uname().nodename}.{os.getpid()}")
    old = fresh.with_name(f"{fresh.name}.old")
    shutil.copytree(image, fresh)
    try:
        if folder.exists():
            folder.rename(old)
        fresh.rename(folder)
    except OSError:  # another container was faster
        shutil.rmtree(fresh, ignore_errors=True)
    shutil.rmtree(old, ignore_errors=True)


def main(command: list[str]) -> None:
    """Run the command in this process's place."""
    if USES_KERNELS & set(command[1:2]):
        place_kernels(IMAGE, Path(os.environ["NUMBA_CACHE_DIR"]))
    os.execvp(command[0], command)


if __name__ == "__main__":
    main(sys.argv[1:])
