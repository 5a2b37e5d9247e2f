"""When images were taken, and the pose of a trajectory that is nearest in time to each."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from pathlib import Path, PurePosixPath

import numpy as np

from biresnerf.data.model.untrusted_file import read_text

TIMES_OF_IMAGES = "rgb.txt"  # of TUM's sets
MAX_TIME_APART_S = 0.02  # between an image and its pose, as in TUM's own tools


def times_of_images(names: Sequence[str], root: Path) -> tuple[dict[str, float], str]:
    """When each image was taken, s, as rgb.txt or its own name gives it."""
    times: dict[str, float] = {}
    table = root / TIMES_OF_IMAGES
    if table.is_file():
        by_base = {PurePosixPath(name).name: name for name in names}
        for line in read_text(table).splitlines():
            words = line.split(maxsplit=1)
            if len(words) == 2 and not words[0].startswith("#"):
                time, name = number_of(words[0]), by_base.get(PurePosixPath(words[1].strip()).name)
                if time is not None and name is not None:
                    times[name] = time
        return times, "by rgb.txt"
    for name in names:
        number = time_in(PurePosixPath(name).stem)
        if number is not None:
            times[name] = number
    return times, "by the images' names"


def time_in(stem: str) -> float | None:
    """The time in a photo's name: the number with most digits, behind a prefix or before more words.

    ROS writes seconds and nanoseconds apart (1403636580_013555584).
    """
    stem = re.sub(r"(?<!\d)(\d{10})[_-](?=\d{6,9}(?!\d))", r"\1.", stem)
    return number_of(max(re.findall(r"\d+(?:\.\d+)?", stem), key=len, default=""))


def in_seconds(time: float) -> float:
    """A time since 1970 in seconds, whether given in s, ms, us or ns; other numbers unchanged."""
    for least, unit in ((1e17, 1e-9), (1e14, 1e-6), (1e11, 1e-3)):
        if least <= time < 1e4 * least:
            return time * unit
    return time


def number_of(word: str) -> float | None:
    """The finite number that a word is, or None."""
    try:
        number = float(word)
    except ValueError:
        return None
    return number if math.isfinite(number) else None


def nearest_poses(taken: dict[str, float], times: Sequence[float]) -> dict[str, int]:
    """The pose nearest in time to each image, where one is near enough; each pose for the image nearest to it.

    Times may be in s, ms, us or ns: those since 1970 show it by their size, others are tried in each.
    """
    times = [in_seconds(time) for time in times]
    tried = [
        _nearest({name: in_seconds(time) * unit for name, time in taken.items()}, times)
        for unit in (1.0, 1e-3, 1e-6, 1e-9)
    ]
    return max(tried, key=len)


def _nearest(taken: dict[str, float], times: Sequence[float]) -> dict[str, int]:
    order = np.argsort(times)
    ordered = np.array(times)[order]
    best: dict[int, tuple[float, str]] = {}
    for name, time in taken.items():
        right = int(np.searchsorted(ordered, time))
        for k in (right - 1, right):
            if 0 <= k < len(ordered) and abs(ordered[k] - time) <= MAX_TIME_APART_S:
                index = int(order[k])
                best[index] = min(best.get(index, (math.inf, "")), (abs(float(ordered[k]) - time), name))
    found: dict[str, tuple[float, int]] = {}
    for index, (apart, name) in best.items():
        found[name] = min(found.get(name, (math.inf, -1)), (apart, index))
    return {name: index for name, (_, index) in found.items()}
