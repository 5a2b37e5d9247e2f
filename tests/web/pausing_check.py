"""A check program for the tests of the page: the real one, which waits after its third photo for a file `go`.

The file lies in the service's data folder.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

from workers.datasets import dataset_check_process

PAUSE_AT = 3
folder = Path(sys.argv[1])
go = next(parent for parent in folder.parents if parent.name == "data") / "go"
check = dataset_check_process.check


def paused(on_photo: Callable[[int, int], object], read: int, photos: int) -> None:
    on_photo(read, photos)
    while read == PAUSE_AT and not go.exists():
        time.sleep(0.05)


dataset_check_process.check = lambda folder, shown, on_photo: check(folder, shown, partial(paused, on_photo))
dataset_check_process.confine()
sys.exit(dataset_check_process.main(folder))
