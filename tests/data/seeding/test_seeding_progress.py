"""How often a run looks at what COLMAP has done."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

from biresnerf.data.seeding import seeding_progress
from biresnerf.data.seeding.seeding_progress import LOOK_EVERY_S, LOOK_SHARE, SeedingProgress, SeedingWatch


def test_showing_many_photos_takes_a_twentieth_of_the_time_that_colmap_takes(monkeypatch):
    clock, told = [0.0], []
    monkeypatch.setattr(seeding_progress.time, "monotonic", lambda: clock[0])
    monkeypatch.setattr(seeding_progress, "read_progress", lambda *_: SeedingProgress({len(told): 1}))

    def tell(found: SeedingProgress) -> None:
        told.append(clock[0])
        clock[0] += 0.01 if len(told) < 5 else 1.0

    watch = SeedingWatch(Path("none.db"), 0, tell)
    while clock[0] < 100:
        watch.look()
        clock[0] += 0.1
    apart = [after - before for before, after in pairwise(told)]
    assert all(LOOK_EVERY_S <= each < LOOK_EVERY_S + 0.2 for each in apart[:4])
    assert all(1 / LOOK_SHARE < each < 1 / LOOK_SHARE + 1.2 for each in apart[4:])
    assert len(apart) > 6
