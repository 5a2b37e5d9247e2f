"""What a run works on, once it is known where it starts."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from biresnerf.data.model.dataset import Dataset
from biresnerf.data.photos.images import ImageSet
from biresnerf.data.points.feature_matches import FeatureMatches
from biresnerf.refine.start.choose_start import Start


@dataclass(frozen=True, eq=False)
class RunInput:
    """The set, its photos, where it starts, which views are kept from the field, and what else is known.

    Attributes:
        dataset: the set, with the poses that the result is compared with.
        images: its photos at the working size.
        start: the poses that the optimisation starts from.
        held_out: indices of the views that are kept from the field to be scored.
        matches: feature matches of the photos, where any were looked for and found.
    """

    dataset: Dataset
    images: ImageSet
    start: Start
    held_out: list[int]
    matches: FeatureMatches | None = None

    @property
    def untaught(self) -> list[int]:
        """Indices of all views that teach the field nothing: those held out, and strays, whose poses are doubtful."""
        return sorted({*self.held_out, *np.flatnonzero(self.start.stray).tolist()})
