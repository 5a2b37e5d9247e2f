"""Where photos were taken, as something beside their poses says."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, eq=False)
class PositionPriors:
    """Where photos were taken, as measured.

    Attributes:
        source: what says so, for messages.
        rows: int64 [m], the frames that have a position.
        positions_m: float64 [m, 3]: along east, north and up from the origin, or in the source's own frame.
        accuracy_m: float64 [m, 3], standard deviations along the axes; NaN where they are not said.
        origin: latitude, longitude (degrees) and height (m), the median of all; None for a frame of the source's own.
        epsg: EPSG's number of the origin's coordinates, or of the source's frame; None where it is not known.
    """

    source: str
    rows: NDArray[np.int64]
    positions_m: NDArray[np.float64]
    accuracy_m: NDArray[np.float64]
    origin: tuple[float, float, float] | None
    epsg: int | None

    def of(self, frames: NDArray[np.bool_]) -> PositionPriors:
        """Those of these frames [n] alone, with the same origin."""
        kept = frames[self.rows]
        return replace(
            self, rows=self.rows[kept], positions_m=self.positions_m[kept], accuracy_m=self.accuracy_m[kept]
        )
