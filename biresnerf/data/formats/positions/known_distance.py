"""The scale of a set by a measured distance: between two photos, or two points of its world."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from biresnerf.data.model.dataset import Dataset
from biresnerf.errors import InputError
from biresnerf.uncertainty import KnownScale

_HINT = "Write two photos' names, or two points x y z of the input's world, and metres: `a.jpg, b.jpg, 1.25`."


@dataclass(frozen=True)
class KnownDistance:
    """A measured distance: its ends are frames, or points [3] in the input's world."""

    names: tuple[str, str]
    ends: tuple[int | tuple[float, float, float], int | tuple[float, float, float]]
    metres: float

    @classmethod
    def of(cls, text: str, dataset: Dataset) -> KnownDistance | None:
        """The distance that the option states; None where it is empty.

        Raises:
            InputError: ``known_distance_invalid``.
        """
        if not text.strip():
            return None
        first, separator, rest = text.partition(",")
        second, last, number = rest.rpartition(",")
        try:
            metres = float(number)
        except ValueError:
            metres = math.nan
        if not separator or not last or not 0 < metres < 1e9:
            raise _invalid("does not end with a distance in metres above zero")
        names = (first.strip(), second.strip())
        ends = (_end(names[0], dataset), _end(names[1], dataset))
        if ends[0] == ends[1]:
            raise _invalid("names one place twice")
        return cls(names, ends, metres)

    def scale(self, world_from_cam: NDArray[np.float64]) -> KnownScale | None:
        """Metres per unit where the cameras have these poses [n, 4, 4]; None where both ends are at one place."""
        places = [world_from_cam[end, :3, 3] if isinstance(end, int) else np.array(end) for end in self.ends]
        units = float(np.linalg.norm(places[0] - places[1]))
        if not units > 0:
            return None
        return KnownScale(between=self.names, metres=self.metres, metres_per_unit=self.metres / units)


def _end(name: str, dataset: Dataset) -> int | tuple[float, float, float]:
    if rows := dataset.called(name):
        return rows[0]
    try:
        x, y, z = (float(word) for word in name.split())
    except ValueError:
        raise _invalid(f"has {name[:100]!r}, which is neither a photo nor three numbers") from None
    if not all(map(math.isfinite, (x, y, z))):
        raise _invalid(f"has {name[:100]!r}, which is no point")
    return x, y, z


def _invalid(what: str) -> InputError:
    return InputError("known_distance_invalid", f"{what}.", where="known_distance", hint=_HINT)
