"""How far COLMAP is, looked up in its database while it works: features of each image, matched pairs."""

from __future__ import annotations

import sqlite3
import time
from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass, field, replace
from pathlib import Path

LOOK_EVERY_S, LOOK_SHARE = 2.0, 0.05  # and the most of the time: thousands of photos take a second to show
# Beside the database: the pairs to match, where not all are, and a sign that they are matched. The database does not
# show it: pairs that contradict the others are taken out of it again.
PAIRS, MATCHED = "pairs.txt", "matched"
_MOST_IMAGES = 2_147_483_647  # of a pair's number in COLMAP's database, a pair being number * most + number


@dataclass(frozen=True)
class SeedingProgress:
    """What is known of the images so far, all by their indices.

    Attributes:
        features: how many each has, of those that were looked at.
        matches: how many features each verified pair has in common; only pairs with any.
        tried: how many pairs were verified, of `pairs` in all.
        matched: whether matching is over.
        kept: a new copy of all this, for a run that goes on later.
    """

    features: dict[int, int] = field(default_factory=dict)
    matches: dict[tuple[int, int], int] = field(default_factory=dict)
    tried: int = 0
    pairs: int = 0
    matched: bool = False
    kept: Path | None = None


OnSeeding = Callable[[SeedingProgress], None]


def read_progress(database: Path, pairs: int) -> SeedingProgress | None:
    """What the database of images called by their numbers holds now; none while it cannot be read.

    So many pairs are expected, unless it is known by now.
    """
    if not database.is_file():
        return None
    listed, matched = database.with_name(PAIRS), database.with_name(MATCHED).is_file()
    if listed.is_file():
        pairs = len(listed.read_text("utf-8").splitlines())
    try:
        with closing(sqlite3.connect(f"{database.as_uri()}?mode=ro", uri=True, timeout=0.1)) as opened:
            names = dict(opened.execute("SELECT image_id, name FROM images"))
            features = opened.execute("SELECT image_id, rows FROM keypoints").fetchall()
            tried = opened.execute("SELECT pair_id, rows FROM two_view_geometries").fetchall()
    except sqlite3.Error:  # it is being made, or written to
        return None
    index = {image: int(Path(name).stem) for image, name in names.items()}
    matches = {}
    for pair, count in tried:
        if count == 0:
            continue
        a, b = sorted((index[pair // _MOST_IMAGES], index[pair % _MOST_IMAGES]))
        matches[a, b] = count
    counts = {index[image]: count for image, count in features}
    return SeedingProgress(counts, matches, len(tried), pairs, matched)


class SeedingWatch:
    """Reports news in the database when `look` is called, at most every few seconds.

    Args:
        kept: where copies of the database go.
    """

    def __init__(self, database: Path, pairs: int, tell: OnSeeding, kept: Path | None = None) -> None:
        self._database, self._pairs, self._tell, self._kept = database, pairs, tell, kept
        self._told, self._next = SeedingProgress(), time.monotonic() + LOOK_EVERY_S
        self._copied_at = self._time_of_copy()

    def look(self) -> None:
        """Report if it is time and there is news."""
        if (began := time.monotonic()) < self._next:
            return
        found = read_progress(self._database, self._pairs)
        copied_at = self._time_of_copy()
        if found is not None and (found != self._told or copied_at != self._copied_at):
            self._told = found
            self._tell(replace(found, kept=self._kept if copied_at != self._copied_at else None))
            self._copied_at = copied_at
        ended = time.monotonic()
        self._next = ended + max(LOOK_EVERY_S, (ended - began) / LOOK_SHARE)

    def _time_of_copy(self) -> int:
        if self._kept is None or not self._kept.is_file():
            return 0
        return self._kept.stat().st_mtime_ns
