"""Models that feature matches support, carried into the frame of given poses, and believed or not."""

from __future__ import annotations

import importlib.util
import logging
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from biresnerf.data.model.dataset import Dataset
from biresnerf.data.photos.geotags import read_geotag
from biresnerf.data.seeding.map_images import MappedModel
from biresnerf.geometry.focus import focus_point
from biresnerf.geometry.geodesy import east_north_up
from biresnerf.geometry.pose_error import rotation_between_deg
from biresnerf.geometry.similarity import align_robust
from biresnerf.uncertainty import GeoReference

logger = logging.getLogger(__name__)

# A camera that leaves its given pose by far more than the others do was placed by wrong matches (global mapping turned
# one of lego's by 92 deg where the others moved by 12): this many medians, but not below these floors. Rotations tell
# most. Noisy positions of few cameras scatter: at noise 0.15 true poses of 10 to 20 cameras are up to 6 medians away.
STRAY_TURNS, STRAY_DEG = 4.0, 30.0
STRAY_SHIFTS, STRAY_SHARE = 8.0, 0.2  # the floor is a share of the cameras' distance
# A model with more of them is wrong as a whole (lego at 100 px: 23 of 78 stray, and the others are off by 17 deg).
STRAY_MOST = 0.15
# GPS gives a frame if so many placed photos have a position, and if these scatter about the cameras by less than this
# share of how far they spread along their second axis: the turn about the first is off by about as many radians,
# over the root of the number of photos.
LEAST_GEOTAGGED, MOST_SCATTER = 6, 0.2
FARTHEST = 10  # median distances from the middle: a position beyond is wrong
JUDGED_FROM = 3  # given poses in a model; fewer tie it to their frame and say nothing of it


@dataclass(frozen=True, eq=False)
class MatchedPoses:
    """Poses that one way of mapping found, in the frame of the given ones.

    Attributes:
        mapper: ``incremental`` or ``global``.
        world_from_cam: float64 [n, 4, 4]; as given where not placed.
        placed: bool [n], whether matches gave the pose.
        geo_reference: where GPS gave the frame.
    """

    mapper: str
    world_from_cam: NDArray[np.float64]
    placed: NDArray[np.bool_]
    geo_reference: GeoReference | None = None


def can_match() -> bool:
    """Whether COLMAP is installed."""
    return importlib.util.find_spec("pycolmap") is not None


def carry_model(
    model: MappedModel, given: NDArray[np.float64], posed: NDArray[np.bool_], *, judged: bool = True
) -> MatchedPoses | None:
    """A model in the frame of the given poses [n, 4, 4], of which those ``posed`` [n] count.

    Cameras that stray from their given pose by far more than the others are left at it, unless ``judged`` is false.
    None where too many do, or where the model holds no image with a given pose.
    """
    rows = model.rows
    common = posed[rows]
    if not common.any():
        return None
    there = given[rows][common]
    similarity = align_robust(model.world_from_cam[common], there, with_rotations=True)
    found = similarity.apply_to_poses(model.world_from_cam)
    trusted = np.ones(len(rows), dtype=np.bool_)
    if judged and common.sum() >= JUDGED_FROM:
        here = found[common]
        turned = rotation_between_deg(here, there)
        shifted = np.linalg.norm(here[:, :3, 3] - there[:, :3, 3], axis=1)
        nearby = STRAY_SHARE * focus_point(given[posed]).mean_distance
        trusted[common] = (turned <= max(STRAY_DEG, STRAY_TURNS * float(np.median(turned)))) & (
            shifted <= max(nearby, STRAY_SHIFTS * float(np.median(shifted)))
        )
        if trusted[common].mean() < 1 - STRAY_MOST:
            logger.info(
                "%s mapping rejected: %d of %d images leave their given pose by far more than the others",
                model.mapper, (~trusted).sum(), common.sum(),
            )  # fmt: skip
            return None
    poses = given.copy()
    poses[rows[trusted]] = found[trusted]
    placed = np.zeros(len(given), dtype=np.bool_)
    placed[rows[trusted]] = True
    return MatchedPoses(model.mapper, poses, placed)


def in_earth_frame(matched: MatchedPoses, dataset: Dataset) -> MatchedPoses:
    """Poses in metres along east, north and up at the median of the photos' GPS positions, where these tell that.

    By a similarity that is robust to wrong positions. Otherwise the poses stay as they are.
    """
    tags = {
        i: tag
        for i, frame in enumerate(dataset.frames)
        if matched.placed[i] and (tag := read_geotag(frame.path, frame.name)) is not None
    }
    if len(tags) < LEAST_GEOTAGGED:
        if tags:
            logger.info(
                "GPS gives no frame: %d placed photos have a position, %d needed", len(tags), LEAST_GEOTAGGED
            )
        return matched
    rows, places = np.array(list(tags)), np.stack(list(tags.values()))
    origin = np.median(places, axis=0)
    there = np.tile(np.eye(4), (len(rows), 1, 1))
    there[:, :3, 3] = east_north_up(places, origin)
    # The fit is robust from a start that a few gross errors must not spoil.
    away = np.linalg.norm(there[:, :3, 3], axis=1)
    sound = away <= FARTHEST * np.median(away)
    rows, there = rows[sound], there[sound]
    try:
        earth_from_model = align_robust(matched.world_from_cam[rows], there)
    except ValueError:  # all at one place
        return matched
    found = earth_from_model.apply_to_poses(matched.world_from_cam)
    apart = np.linalg.norm(found[rows, :3, 3] - there[:, :3, 3], axis=1)
    near = found[rows, :3, 3][apart <= 3 * np.median(apart)]
    spread = float(np.linalg.svd(near - near.mean(0), compute_uv=False)[1]) / len(near) ** 0.5
    residual = float(np.median(apart))
    if not residual < MOST_SCATTER * spread:  # neither where both are zero
        logger.info(
            "GPS gives no frame: positions scatter by %.1f m, cameras spread by %.1f m", residual, spread
        )
        return matched
    latitude, longitude, altitude = origin.tolist()
    reference = GeoReference(
        latitude=latitude, longitude=longitude, altitude=altitude, images=len(rows), residual_m=residual
    )
    return replace(
        matched,
        world_from_cam=np.where(matched.placed[:, None, None], found, matched.world_from_cam),
        geo_reference=reference,
    )
