"""A complete set of poses that a run could start from, with what found each of them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import PlainSerializer, PlainValidator

from biresnerf.data.model.dataset import GUESSES, Dataset
from biresnerf.data.model.image_order import natural_order
from biresnerf.geometry.level_ring import level_ring
from biresnerf.report import PoseSource, TrialReport

MATCHED_SOURCES: frozenset[PoseSource] = frozenset(
    {"colmap", "matches-incremental", "matches-global", "matches-parts"}
)
MOSTLY_MATCHED = 0.8  # share of the cameras from which on feature matches placed most
DOUBTED = GUESSES | {"gimbal"}  # poses that need not agree with those of the other cameras
GUESSED_MOST = 0.5  # of the cameras: with more guesses there is no field of others to agree with

_IN_JSON = (
    PlainValidator(lambda value: None if value is None else np.array(value, dtype=np.float64)),
    PlainSerializer(lambda poses: None if poses is None else poses.tolist()),
)
# Float64 [n, 4, 4]; in JSON a list of lists.
PoseArray = Annotated[NDArray[np.float64], *_IN_JSON]
MaybePoseArray = Annotated[NDArray[np.float64] | None, *_IN_JSON]


@dataclass(frozen=True, eq=False)
class InitialPoses:
    """Poses to start from.

    Attributes:
        world_from_cam: float64 [n, 4, 4], in the frame of the given poses.
        source: of the set as a whole.
        sources: of each pose.
        trials: how every candidate did in the choice between several; empty if there was only one.
        matched_poses: float64 [n, 4, 4], the best set that feature matches support, whichever set is started from; None
            where there is none.
    """

    world_from_cam: PoseArray
    source: PoseSource
    sources: tuple[PoseSource, ...]
    trials: tuple[TrialReport, ...] = ()
    matched_poses: MaybePoseArray = None

    @property
    def matched(self) -> NDArray[np.bool_]:
        """Which poses [n] come from feature matches."""
        return np.array([source in MATCHED_SOURCES for source in self.sources])

    @property
    def mostly_matched(self) -> bool:
        """Whether feature matches placed most cameras."""
        return bool(self.matched.mean() >= MOSTLY_MATCHED)

    @property
    def guessed(self) -> NDArray[np.bool_]:
        """Which poses [n] are guesses, or a gimbal's; none where most are, as all are equally doubtful then."""
        guessed = np.array([source in DOUBTED for source in self.sources])
        return guessed if guessed.mean() <= GUESSED_MOST else np.zeros_like(guessed)

    @property
    def unmatched(self) -> NDArray[np.bool_]:
        """Which cameras [n] matches left out where they placed most.

        Such a camera must not train the field: one of few photos finds room for itself from any pose, however small
        its weight (fountain-P11's sixth, 20 degrees off, went unnoticed).
        """
        matched = self.matched
        return ~matched if self.mostly_matched else np.zeros_like(matched)

    @property
    def reliable(self) -> NDArray[np.bool_]:
        """Which poses [n] are as good as any of the set."""
        return ~(self.guessed | self.unmatched)


def even_ring(dataset: Dataset) -> InitialPoses:
    """All images evenly on a level ring about the z axis, in the order of their names."""
    name: PoseSource = "turntable"
    count = len(dataset)
    azimuth = np.empty(count)
    azimuth[natural_order(dataset.file_names)] = np.arange(count) * (2 * np.pi / count)
    return InitialPoses(level_ring(azimuth), name, (name,) * count)
