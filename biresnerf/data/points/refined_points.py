"""The sparse points of a result: triangulated anew at the refined poses, never those of the poses before.

Trainers start from these points, and points that lie beside the refined cameras' rays undo the refinement
(nerfstudio's users, issue 3443).
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from biresnerf.data.model.colmap_scene import NO_POINT, ColmapModel, ColmapPoints, matrix_of_pose
from biresnerf.data.model.refined_set import RefinedSet
from biresnerf.data.model.result_model import with_points
from biresnerf.data.photos.images import ImageSet
from biresnerf.data.points.tracks import Tracks
from biresnerf.geometry.camera.pixel_rays import pixels_of_points, rays_of_pixels
from biresnerf.geometry.rigid import rigid_inverse
from biresnerf.geometry.triangulation import parallax_deg, triangulate

# COLMAP's own bounds for a point worth keeping.
MOST_ERROR_PX, LEAST_PARALLAX_DEG = 4.0, 1.5
LEAST_AGREEING = 0.5  # of a track's observations: two of eight wrong ones agree on something by chance
NEAREST = 4  # cameras that carry a point along that no image is known to see
DISTANCES_AT_ONCE = 2**22  # of points from cameras


class FieldPoints(NamedTuple):
    """Where rays of rendered views end in the radiance field.

    Attributes:
        xyz: float64 [m, 3], in the caller's world.
        rgb: uint8 [m, 3].
        world_from_cam: the poses [n, 4, 4] that the field was trained on.
    """

    xyz: NDArray[np.float64]
    rgb: NDArray[np.uint8]
    world_from_cam: NDArray[np.float64]


def with_points_of(
    refined: RefinedSet,
    given: ColmapModel | None,
    tracks: Tracks | None,
    images: ImageSet,
    field: FieldPoints | None = None,
) -> RefinedSet:
    """The result with the best points there are.

    Those of the input's tracks, else of feature matches, else the input's points carried along, else the field's.

    Args:
        refined: without points.
        given: the input, where it was a COLMAP model.
        tracks: through feature matches, of frames in the order of ``refined``.
        images: the photos, for colours.
        field: points of the radiance field.
    """
    if given is not None and len(given.points.track_image_ids):
        return with_given_points(refined, given)
    if tracks is not None:
        matched = with_matched_points(refined, tracks, images)
        if len(matched.model.points):
            return matched
    if given is not None and len(given.points):
        return with_given_points(refined, given)
    return refined if field is None else with_field_points(refined, field)


def with_matched_points(refined: RefinedSet, tracks: Tracks, images: ImageSet) -> RefinedSet:
    """The result with points triangulated from tracks; the model's features are then those of the tracks."""
    ids = np.array(refined.image_ids)
    model_images = dict(refined.model.images)
    feature = np.zeros(len(tracks), dtype=np.int64)  # of each observation: row among its photo's features
    by_image = np.argsort(tracks.image, kind="stable")
    begin = np.searchsorted(tracks.image[by_image], np.arange(len(refined) + 1))
    for row, number in enumerate(refined.image_ids):
        own = by_image[begin[row] : begin[row + 1]]
        feature[own] = np.arange(len(own))
        none = np.full(len(own), NO_POINT)
        model_images[number] = replace(model_images[number], points2d_px=tracks.xy[own], point3d_ids=none)
    starts = np.concatenate(([0], np.cumsum(tracks.lengths))).astype(np.int64)
    seen = np.stack(
        [_colour(images, refined, i, xy) for i, xy in zip(tracks.image.tolist(), tracks.xy, strict=True)]
    )
    rgb = np.add.reduceat(seen, starts[:-1], axis=0) / tracks.lengths[:, None]
    count = tracks.points
    points = ColmapPoints(
        np.arange(1, count + 1), np.zeros((count, 3)), np.rint(rgb).astype(np.uint8), np.full(count, -1.0),
        starts, ids[tracks.image], feature,
    )  # fmt: skip
    model = replace(refined.model, images=model_images)
    return replace(refined, model=with_points(model, triangulated(model, points)), points_source="features")


def _colour(
    images: ImageSet, refined: RefinedSet, photo: int, xy: NDArray[np.float64]
) -> NDArray[np.float64]:
    """The photo's colour [3] at a position in full-size pixels."""
    picture, camera = images.image(photo), refined.camera_of(photo)
    height, width = picture.shape[:2]
    column = min(max(int(xy[0] * width / camera.width), 0), width - 1)
    row = min(max(int(xy[1] * height / camera.height), 0), height - 1)
    return picture[row, column].astype(np.float64)


def with_given_points(refined: RefinedSet, given: ColmapModel) -> RefinedSet:
    """The result with the points of the model that the input was.

    Where nothing moved, they are taken as they are. Points with tracks are triangulated from the refined cameras, and
    left out where those do not agree on them. Points without tracks are carried along by the cameras nearest to them.
    """
    if len(given.points) == 0:
        return refined
    if _unmoved(refined, given):
        return replace(refined, model=with_points(refined.model, given.points), points_source="given")
    if len(given.points.track_image_ids):
        points = triangulated(refined.model, given.points)
        return replace(refined, model=with_points(refined.model, points), points_source="tracks")
    pairs = [(image.given, image.world_from_cam) for image in refined.images if image.given is not None]
    before, after = (np.stack(poses) for poses in zip(*pairs, strict=True))
    points = replace(given.points, xyz=_carried(given.points.xyz, before, after))
    return replace(refined, model=with_points(refined.model, points), points_source="moved")


def with_field_points(refined: RefinedSet, field: FieldPoints) -> RefinedSet:
    """The result with points of the field, which no image is known to see, carried to its poses where those differ."""
    if not len(field.xyz):
        return refined
    count, xyz, none = len(field.xyz), field.xyz, np.zeros(0, np.int64)
    if not np.array_equal(field.world_from_cam, refined.world_from_cam):
        xyz = _carried(xyz, field.world_from_cam, refined.world_from_cam)
    points = ColmapPoints(
        np.arange(1, count + 1),
        xyz,
        field.rgb,
        np.full(count, -1.0),
        np.zeros(count + 1, np.int64),
        none,
        none,
    )
    return replace(refined, model=with_points(refined.model, points), points_source="field")


def _unmoved(refined: RefinedSet, given: ColmapModel) -> bool:
    model = refined.model
    return all(
        number in model.images
        and np.array_equal(model.images[number].cam_from_world.quat_wxyz, image.cam_from_world.quat_wxyz)
        and np.array_equal(model.images[number].cam_from_world.translation, image.cam_from_world.translation)
        and model.cameras[image.camera_id] == given.cameras[image.camera_id]
        for number, image in given.images.items()
    )


def triangulated(model: ColmapModel, tracks: ColmapPoints) -> ColmapPoints:
    """The points of ``tracks`` as the model's cameras see them; ids and colours stay.

    Observations that are off by more than `MOST_ERROR_PX` are left out, and points that most of their observations do
    not agree on, that fewer than two images see, or those only by rays within `LEAST_PARALLAX_DEG` of each other.
    """
    lengths, owner = np.diff(tracks.track_starts), tracks.owner
    kept = np.isin(tracks.track_image_ids, list(model.images))
    errors = np.full(len(tracks), -1.0)
    xyz = np.zeros((len(tracks), 3))
    good = np.zeros(len(tracks), dtype=np.bool_)
    # First with all observations, robustly; then with those that agree.
    for last in (False, True):
        seen = np.bincount(owner[kept], minlength=len(tracks)) >= 2
        kept &= seen[owner]
        rows, point = np.unique(owner[kept], return_inverse=True)
        views = _Views(model, tracks.track_image_ids[kept], tracks.track_point2d_indices[kept])
        found = triangulate(views.origins, views.directions, views.focal_px, point, len(rows))
        off_px = views.errors_px(found[point])
        agree = off_px <= MOST_ERROR_PX  # NaN, from behind, is no agreement
        if not last:
            kept[np.flatnonzero(kept)[~agree]] = False
            agreeing = np.bincount(owner[kept], minlength=len(tracks)) / np.maximum(lengths, 1)
            kept &= (agreeing >= LEAST_AGREEING)[owner]
            continue
        xyz[rows] = found
        errors[rows] = np.bincount(point, np.nan_to_num(off_px, nan=np.inf)) / np.maximum(
            np.bincount(point), 1
        )
        good[rows] = errors[rows] <= MOST_ERROR_PX
        good[rows] &= parallax_deg(views.origins, found, point) >= LEAST_PARALLAX_DEG
    kept &= good[owner]
    return replace(tracks, xyz=xyz, errors=errors).only(good, kept)


class _Views:
    """The rays of observations: from which camera, in which direction."""

    def __init__(self, model: ColmapModel, image_ids: NDArray[np.int64], features: NDArray[np.int64]) -> None:
        self.model, self.image_ids = model, image_ids
        count = len(image_ids)
        self.pixel_xy, self.focal_px = np.zeros((count, 2)), np.zeros(count)
        self.origins, self.directions = np.zeros((count, 3)), np.zeros((count, 3))
        for number in np.unique(image_ids).tolist():
            rows, image = image_ids == number, model.images[number]
            lens = model.cameras[image.camera_id].full()
            world_from_cam = image.world_from_cam
            self.pixel_xy[rows] = image.points2d_px[features[rows]]
            self.focal_px[rows] = (lens.fx * lens.fy) ** 0.5
            self.origins[rows] = world_from_cam[:3, 3]
            self.directions[rows] = rays_of_pixels(lens, self.pixel_xy[rows]) @ world_from_cam[:3, :3].T

    def errors_px(self, xyz: NDArray[np.float64]) -> NDArray[np.float64]:
        """How far from its feature each observation's point [observations, 3] appears; NaN from behind."""
        off = np.zeros(len(xyz))
        for number in np.unique(self.image_ids).tolist():
            rows, image = self.image_ids == number, self.model.images[number]
            pose = matrix_of_pose(image.cam_from_world)
            in_cam = xyz[rows] @ pose[:3, :3].T + pose[:3, 3]
            there = pixels_of_points(self.model.cameras[image.camera_id].full(), in_cam)
            off[rows] = np.linalg.norm(there - self.pixel_xy[rows], axis=1)
        return off


def _carried(
    xyz: NDArray[np.float64], before: NDArray[np.float64], after: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Points [m, 3] moved as the cameras nearest to them moved between poses [n, 4, 4], the nearer the more."""
    after_from_before = after @ rigid_inverse(before)
    centres = before[:, :3, 3]
    carried = np.empty_like(xyz)
    few = min(NEAREST, len(centres))
    for part in np.array_split(np.arange(len(xyz)), 1 + len(xyz) * len(centres) // DISTANCES_AT_ONCE):
        away = np.linalg.norm(xyz[part, None] - centres[None], axis=2)
        nearest = np.argpartition(away, few - 1, axis=1)[:, :few]
        weights = 1.0 / np.maximum(np.take_along_axis(away, nearest, 1), 1e-12) ** 2
        weights /= weights.sum(1, keepdims=True)
        moved = np.einsum("mkij,mj->mki", after_from_before[nearest][..., :3, :3], xyz[part])
        moved += after_from_before[nearest][..., :3, 3]
        carried[part] = (weights[..., None] * moved).sum(1)
    return carried
