"""The tracks of a set as evidence, as in a run's adjustment."""

from __future__ import annotations

from biresnerf.data.model.dataset import Dataset
from biresnerf.data.points.tracks import Tracks
from biresnerf.geometry.camera.camera import Intrinsics
from biresnerf.refinement.adjustment.evidence import Evidence
from biresnerf.refinement.adjustment.ideal import ideal_cameras, straight_tracks
from biresnerf.refinement.numbers.finish import EvidenceNumbers

MOST_OBSERVATIONS = EvidenceNumbers().most_observations


def fitted_tracks(dataset: Dataset, tracks: Tracks | None, most: int = MOST_OBSERVATIONS) -> Evidence:
    """The points for fitting, with at most `most` observations, through the set's lenses."""
    intrinsics = Intrinsics.from_cameras([dataset.camera_of(i) for i in range(len(dataset))])
    ideal = ideal_cameras(intrinsics)
    if tracks is None:
        raise SystemExit("no feature matches")
    fitted = straight_tracks(tracks, intrinsics, ideal).split()[0]
    assert fitted is not None
    return Evidence(ideal, fitted.thinned(most, len(dataset)))
