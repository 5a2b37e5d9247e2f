"""What a run works on once its initial poses are known."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from biresnerf.data.model.dataset import Dataset
from biresnerf.data.photos.images import ImageSet
from biresnerf.data.points.tracks import Tracks
from biresnerf.data.seeding.initial_poses import InitialPoses


@dataclass(frozen=True, eq=False)
class Scene:
    """A set of photos with initial poses.

    Attributes:
        dataset: the set, with the poses that the result is compared with.
        images: its photos at the working size.
        start: the poses that the optimisation starts from.
        held_out: indices of the views that the field is not trained on, to be scored.
        tracks: through feature matches of the photos, where any were looked for and found.
    """

    dataset: Dataset
    images: ImageSet
    start: InitialPoses
    held_out: list[int]
    tracks: Tracks | None = None

    @property
    def excluded_from_training(self) -> list[int]:
        """Indices of all views that the field is not trained on: held out, or unmatched, so of doubtful pose."""
        return sorted({*self.held_out, *np.flatnonzero(self.start.unmatched).tolist()})
