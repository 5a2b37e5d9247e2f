"""The evidence for or against refined poses beside unseen views: feature matches and motion."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from biresnerf.arrays import Array
from biresnerf.data.photos.images import ImageSet
from biresnerf.data.points.tracks import Tracks
from biresnerf.judging.compare import MATCH_ERRORS, octaves, paired
from biresnerf.refinement.lost.own_matches import LEAST_PX, OwnMatches, well_matched
from biresnerf.refinement.views.compare_rigs import Rig
from biresnerf.report import EpipolarEvidence


def compare_on_matches(
    before: Rig,
    after: Rig,
    tracks: Tracks,
    placed: NDArray[np.bool_],
    least: int,
    *,
    started_from_matches: bool,
) -> EpipolarEvidence | None:
    """Each image's median epipolar error with either rig; None where too few images have matches.

    The points are those left out of every estimate, if they are seen in half of the images in which all points are.
    Images without a pose before do not count: any pose is better than a guess.

    Args:
        placed: which images [n] had more than a guess for a pose before.
        least: images with matches that are needed for a finding.
        started_from_matches: whether points not left out had a part in the rig `after`.
    """
    counted = placed if placed.any() else ~placed
    enough = max(least, int((well_matched(tracks, len(placed)) & counted).sum()) / 2)
    judging = tracks.split()[1]
    figures = errors_px(before, after, judging) if judging is not None else None
    if figures is None or _known(figures, counted).sum() < enough:
        judging, figures = None, errors_px(before, after, tracks)
    known = _known(figures, counted)
    if known.sum() < least:
        return None
    one, other = (errors[known] for errors in figures)
    comparison = paired(one, other, MATCH_ERRORS, octaves(one, other, LEAST_PX))
    medians = {"before": float(np.median(one)), "after": float(np.median(other))}
    sides = [max(camera.width, camera.height) for camera in after.cameras]
    return EpipolarEvidence(
        matches=len((judging or tracks).pairs()[0]),
        independent=judging is not None or not started_from_matches,
        error_px=comparison.model_copy(update=medians),
        share_of_image=medians["after"] / float(np.median(sides)),
    )


def errors_px(before: Rig, after: Rig, tracks: Tracks) -> tuple[Array, Array]:
    """Each image's median error [n] with either rig (px, full size); NaN where it has too few matches."""
    old, new = (OwnMatches(tracks, rig.cameras).errors_px(rig.world_from_cam) for rig in (before, after))
    return old, new


def _known(errors: tuple[Array, Array], counted: NDArray[np.bool_]) -> NDArray[np.bool_]:
    return np.isfinite(errors[0]) & np.isfinite(errors[1]) & counted


def working_share(rig: Rig, images: ImageSet) -> float:
    """The photos' long sides at working size over those at full size: the median."""
    full = np.array([max(camera.width, camera.height) for camera in rig.cameras])
    return float(np.median(np.maximum(images.widths, images.heights) / full))
