"""Where photos were taken, by data other than their poses."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, eq=False)
class PositionPriors:
    """Where photos were taken, as measured.

    Attributes:
        source: where the positions come from, for messages.
        rows: int64 [m], the frames that have a position.
        positions_m: float64 [m, 3]: along east, north and up from the origin, or in the source's own frame.
        accuracy_m: float64 [m, 3], standard deviations along the axes; NaN where they are not said.
        origin: latitude, longitude (degrees) and height (m), the median of all; None for a frame of the source's own.
        epsg: EPSG's number of the origin's coordinates, or of the source's frame; None where it is not known.
        rotations: float64 [m, 3, 3], from the cameras' axes to those of the positions, as a drone's gimbal has them;
            NaN for photos that do not say, and None where none does.
    """

    source: str
    rows: NDArray[np.int64]
    positions_m: NDArray[np.float64]
    accuracy_m: NDArray[np.float64]
    origin: tuple[float, float, float] | None
    epsg: int | None
    rotations: NDArray[np.float64] | None = None

    @property
    def turned(self) -> NDArray[np.bool_]:
        """Which positions [m] have a rotation."""
        if self.rotations is None:
            return np.zeros(len(self.rows), dtype=np.bool_)
        return np.asarray(np.isfinite(self.rotations).all((1, 2)))

    def of(self, frames: NDArray[np.bool_]) -> PositionPriors:
        """The positions of these frames [n] alone, with the same origin."""
        kept = frames[self.rows]
        return replace(
            self,
            rows=self.rows[kept],
            positions_m=self.positions_m[kept],
            accuracy_m=self.accuracy_m[kept],
            rotations=None if self.rotations is None else self.rotations[kept],
        )


@dataclass(frozen=True, eq=False)
class ControlPoints:
    """Places on the ground that were measured, and where photos show them; each is in two photos at least.

    Attributes:
        source: the file, for messages.
        names: of the p points.
        metres: float64 [p, 3]: along east, north and up from the origin, or in the source's own frame.
        accuracy_m: float64 [p, 3], standard deviations along the axes; NaN where they are not said.
        check: bool [p], points that nothing is adjusted to, to judge by.
        point, image: int64 [m], of each observation, ascending.
        xy: float64 [m, 2], px of the full-size photos.
        origin, epsg: as those of `PositionPriors`.
    """

    source: str
    names: tuple[str, ...]
    metres: NDArray[np.float64]
    accuracy_m: NDArray[np.float64]
    check: NDArray[np.bool_]
    point: NDArray[np.int64]
    image: NDArray[np.int64]
    xy: NDArray[np.float64]
    origin: tuple[float, float, float] | None
    epsg: int | None

    def of(self, frames: NDArray[np.bool_]) -> ControlPoints:
        """What these frames [n] alone show, with the same origin."""
        return self.seen_in(frames[self.image])

    def seen_in(self, observations: NDArray[np.bool_]) -> ControlPoints:
        """These observations [m] alone, of points that two photos then still show."""
        count = np.bincount(self.point[observations], minlength=len(self.names))
        kept = observations & (count >= 2)[self.point]
        points, number = np.unique(self.point[kept], return_inverse=True)
        return replace(
            self,
            names=tuple(self.names[i] for i in points.tolist()),
            metres=self.metres[points],
            accuracy_m=self.accuracy_m[points],
            check=self.check[points],
            point=number.astype(np.int64),
            image=self.image[kept],
            xy=self.xy[kept],
        )
