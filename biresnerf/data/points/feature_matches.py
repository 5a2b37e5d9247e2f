"""Feature matches between photos, verified by two-view geometry alone: no pose has a say in them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from biresnerf.data.model.atomic_file import whole_file

WRITTEN = "matches.npz"  # in the work folder of `colmap_child`
KEPT = "matches.npz"  # beside what else is kept of COLMAP's answer


@dataclass(frozen=True, eq=False)
class FeatureMatches:
    """Points seen in two photos each.

    Attributes:
        images: int64 [m, 2], indices into the frames of the set.
        xy: float64 [m, 2, 2], where the point lies in the first and the second of them; px of the full-size photos.
    """

    images: NDArray[np.int64]
    xy: NDArray[np.float64]

    def __len__(self) -> int:
        return len(self.images)

    @classmethod
    def load(cls, path: Path, names: tuple[str, ...]) -> FeatureMatches | None:
        """What `keep_matches` left at `path`, of the images `names`; None where there is no such file or match."""
        if not path.is_file():
            return None
        index = {name: i for i, name in enumerate(names)}
        with np.load(path, allow_pickle=False) as kept:
            place = np.array([index.get(str(name), -1) for name in kept["names"]], dtype=np.int64)
            images, xy = place[kept["images"]], kept["xy"]
        known = (images >= 0).all(1)
        return cls.of(images[known], xy[known])

    @classmethod
    def of(cls, images: NDArray[Any], xy: NDArray[Any]) -> FeatureMatches | None:
        """From the arrays of `kept`; None of none. In the precision of `kept`, so that a resumed run has the same."""
        if len(images) == 0:
            return None
        as_kept = np.asarray(xy, np.float32).reshape(-1, 2, 2)
        return cls(np.asarray(images, np.int64), as_kept.astype(np.float64))

    def kept(self) -> tuple[NDArray[np.int32], NDArray[np.float32]]:
        """Arrays to keep, [m, 2] and [m, 4]."""
        return self.images.astype(np.int32), self.xy.reshape(-1, 4).astype(np.float32)


def keep_matches(work: Path, names: tuple[str, ...], path: Path) -> None:
    """Keep what COLMAP's child process wrote to its folder `work`, of images in the order of `names`, as `path`."""
    with np.load(work / WRITTEN, allow_pickle=False) as matches, whole_file(path) as temporary:
        np.savez(temporary, names=np.array(names), images=matches["images"], xy=matches["xy"])
