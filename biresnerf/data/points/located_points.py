"""Where cameras see control points, and how far that is from where these were measured."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from biresnerf.arrays import Array
from biresnerf.data.model.dataset import Dataset
from biresnerf.data.model.measured_places import ControlPoints
from biresnerf.geometry.camera.camera_models import Camera
from biresnerf.geometry.camera.pixel_rays import pixels_of_points, rays_of_pixels
from biresnerf.geometry.earth.georeference import THINNEST, NoGeoreference, fit_positions
from biresnerf.geometry.similarity import Similarity, align_points
from biresnerf.geometry.triangulation import triangulate

logger = logging.getLogger(__name__)


LEAST_POINTS = 3
# A point is far off by so many medians of the others' distances, px of its photos and stated deviations; or by so many
# px whatever the others are off by, as where all contradict the photos.
FAR_OFF, FAR_OFF_PX, FAR_OFF_STATED, FAR_OFF_ANYWAY_PX = 6.0, 8.0, 3.0, 30.0
MOST_FAR_OFF = 0.25  # of the control points; where more are, none is believed
FLAT, UPRIGHT = 0.2, 0.9  # of the spread across; the cosine of a level plane's normal


@dataclass(frozen=True, eq=False)
class LocatedPoints:
    """Control and check points as cameras see them.

    Attributes:
        metres_from_world: the similarity that carries the control points to their coordinates.
        error_m: [p, 3], the points' positions by the cameras minus the measured ones, along the axes.
        error_px: [p], root mean square over a point's photos of how far it appears from its mark.
        far_off: bool [p], see `far_off`.
    """

    metres_from_world: Similarity
    error_m: Array
    error_px: Array
    far_off: NDArray[np.bool_]


def far_off(apart_m: Array, px_m: Array, accuracy_m: Array) -> NDArray[np.bool_]:
    """Mask [p] of points whose coordinates or marks are wrong, judging by the others.

    Args:
        apart_m: how far each is from where photos show it.
        px_m: a pixel's size at each.
        accuracy_m: stated deviations [p, 3]; NaN where there are none.
    """
    others = np.array([np.median(np.delete(apart_m, i)) for i in range(len(apart_m))])
    stated = np.nan_to_num(FAR_OFF_STATED * np.linalg.norm(accuracy_m, axis=1))
    beyond_others = np.minimum(FAR_OFF * others, FAR_OFF_ANYWAY_PX * px_m)
    return np.asarray(apart_m > np.maximum.reduce([beyond_others, FAR_OFF_PX * px_m, stated]))


def _refuse_mirrored(points: ControlPoints, metres: Array, centres: Array) -> None:
    """Level points that cameras [m, 3], in metres, see from below: a flat mirror image fits as well as the truth."""
    _, spread, axes = np.linalg.svd(metres - metres.mean(0))
    level = spread[2] < FLAT * spread[1] and abs(axes[2, 2]) > UPRIGHT
    if level and (points.epsg or points.origin) and np.median(centres[:, 2]) < metres[:, 2].mean():
        raise NoGeoreference(
            "by the control points the cameras look up at the ground: x and y (or latitude and longitude) seem to be "
            "swapped"
        )


def located(points: ControlPoints, world_from_cam: Array, cameras: Sequence[Camera]) -> LocatedPoints:
    """The points by cameras [n, 4, 4] that have these lenses [n].

    Raises:
        NoGeoreference: fewer than three control points, all on a line, or level and seen from below.
    """
    control = ~points.check
    if control.sum() < LEAST_POINTS:
        raise NoGeoreference(
            f"{control.sum()} control points are seen in two photos, and {LEAST_POINTS} are needed"
        )
    spread = np.linalg.svd(points.metres[control] - points.metres[control].mean(0), compute_uv=False)
    if not spread[1] > THINNEST * spread[0]:
        raise NoGeoreference("the control points lie on a line, about which they leave the turn open")
    poses, lenses = world_from_cam[points.image], [camera.full() for camera in cameras]
    rays, seen = np.empty((len(points.image), 3)), np.empty_like(points.xy)
    for image in np.unique(points.image).tolist():
        rays[points.image == image] = rays_of_pixels(lenses[image], points.xy[points.image == image])
    world = np.einsum("mij,mj->mi", poses[:, :3, :3], rays)
    focal = np.array([(lens.fx * lens.fy) ** 0.5 for lens in lenses])[points.image]
    xyz = triangulate(poses[:, :3, 3], world, focal, points.point, len(points.names))
    in_cam = np.einsum("mji,mj->mi", poses[:, :3, :3], xyz[points.point] - poses[:, :3, 3])
    for image in np.unique(points.image).tolist():
        seen[points.image == image] = pixels_of_points(lenses[image], in_cam[points.image == image])
    square = np.bincount(points.point, ((seen - points.xy) ** 2).sum(1)) / np.bincount(points.point)
    found = align_points(xyz[control], points.metres[control])
    _refuse_mirrored(points, points.metres[control], found.apply(poses[control[points.point], :3, 3]))
    error_m = found.apply(xyz) - points.metres
    px_m = found.scale * np.linalg.norm(in_cam, axis=1) / focal
    px_m = np.bincount(points.point, px_m) / np.bincount(points.point)
    return LocatedPoints(
        found, error_m, np.sqrt(square), far_off(np.linalg.norm(error_m, axis=1), px_m, points.accuracy_m)
    )


def metres_from_world(
    dataset: Dataset, world_from_cam: Array, placed: NDArray[np.bool_] | None = None
) -> Similarity | None:
    """The similarity from cameras at poses [n, 4, 4] to measured places: control points, else cameras' positions.

    None where neither determines it. Only cameras that are `placed` [n] count.
    """
    counted = np.ones(len(dataset), np.bool_) if placed is None else placed
    if not np.isfinite(world_from_cam[counted]).all():
        return None
    lenses = [dataset.camera_of(i) for i in range(len(dataset))]
    if dataset.control is not None:
        with suppress(NoGeoreference):
            return located(dataset.control.of(counted), world_from_cam, lenses).metres_from_world
    if dataset.positions is not None:
        priors = dataset.positions.of(counted)
        try:
            return fit_positions(
                world_from_cam[priors.rows], priors.positions_m, rotations=priors.rotations
            ).metres_from_world
        except NoGeoreference as reason:
            logger.info("%s gives no frame: %s", priors.source, reason)
    return None
