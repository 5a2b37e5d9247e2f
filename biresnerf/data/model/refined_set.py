"""A finished result as the writers take it: cameras, poses before and after, the sparse model. Frozen, numpy only."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from biresnerf.data.model.colmap_scene import ColmapModel, no_points
from biresnerf.data.model.dataset import Dataset
from biresnerf.data.model.result_model import model_at_poses, model_of_poses, with_points, with_rigs
from biresnerf.geometry.body_offset import BodyOffset
from biresnerf.geometry.camera.camera_models import Camera
from biresnerf.geometry.rigid import rigid_inverse
from biresnerf.geometry.similarity import Similarity
from biresnerf.uncertainty import PoseUncertainty

# ``given``: the input's, as nothing moved; ``tracks``: its tracks triangulated again; ``features``: matches of features
# triangulated; ``moved``: the input's points carried along with the cameras nearest to them; ``field``: where rays of
# rendered views end in the radiance field.
PointsSource = Literal["none", "given", "features", "tracks", "moved", "field"]
REFINED = "refined"  # where a result that returns the input's poses has the refined ones
BODY = "body"  # where a result has the poses of what carries the camera


class Landmark(NamedTuple):
    """One point of a result, with what photos show of it.

    Attributes:
        number: its id.
        xyz, rgb: position in the world; colour, 0 to 255.
        features: row of the image in the set, number of the feature, and its x and y, px. COLMAP may list several
            features of an image.
    """

    number: int
    xyz: list[float]
    rgb: list[int]
    features: list[tuple[int, int, list[float]]]

    @property
    def seen(self) -> dict[int, tuple[int, list[float]]]:
        """The first feature by the image's row, for programs in which a view sees a point once."""
        seen: dict[int, tuple[int, list[float]]] = {}
        for row, feature, xy in self.features:
            seen.setdefault(row, (feature, xy))
        return seen


@dataclass(frozen=True, eq=False)
class RefinedImage:
    """One image of a result.

    Attributes:
        name: as the caller wrote it.
        file_name: its path relative to the caller's folder, with extension and forward slashes.
        camera: index into `RefinedSet.cameras`.
        world_from_cam: float64 [4, 4], refined, in the caller's world; OpenCV axes.
        given: its pose before, float64 [4, 4]; None where there was none.
        pose_source: who found the pose that the optimisation started from.
        flags: notable facts about it: ``fixed``, ``held_out``, ``repaired``, ...
        path: the file; None where it is not known.
        orientation, levels: as `biresnerf.data.model.dataset.Frame` has them.
        uncertainty: of the pose; None where it is not known.
    """

    name: str
    file_name: str
    camera: int
    world_from_cam: NDArray[np.float64]
    given: NDArray[np.float64] | None
    pose_source: str
    flags: tuple[str, ...] = ()
    path: Path | None = None
    orientation: int = 1
    uncertainty: PoseUncertainty | None = None
    levels: tuple[int, int] | None = None


@dataclass(frozen=True, eq=False)
class RefinedSet:
    """Poses that have been refined, with everything that writers need.

    Attributes:
        cameras: intrinsics at full size.
        images: in the caller's order.
        model: the same as a COLMAP model, with the caller's ids where the input was one, and the points.
        image_ids: of the images in the model.
        points_source: where the model's points come from.
        similarity: ``input_from_optimised``, which tied the poses to the caller's frame.
        timestamps_s: of the images, where the input was a trajectory with times.
        body_offset: of the cameras from the bodies whose poses the input had; None where none was found.
    """

    cameras: tuple[Camera, ...]
    images: tuple[RefinedImage, ...]
    model: ColmapModel
    image_ids: tuple[int, ...]
    points_source: PointsSource
    similarity: Similarity
    timestamps_s: tuple[float, ...] | None = None
    body_offset: BodyOffset | None = None

    def __post_init__(self) -> None:
        poses = [image.world_from_cam for image in self.images]
        if any(pose.shape != (4, 4) or not np.isfinite(pose).all() for pose in poses):
            raise ValueError("poses must be finite and of shape (4, 4)")
        if len({image.file_name for image in self.images}) != len(self.images):
            raise ValueError("images must have different names")

    def __len__(self) -> int:
        return len(self.images)

    @property
    def world_from_cam(self) -> NDArray[np.float64]:
        """The refined poses, float64 [n, 4, 4]."""
        return np.stack([image.world_from_cam for image in self.images])

    @property
    def cam_from_world(self) -> NDArray[np.float64]:
        """The inverses of the refined poses, float64 [n, 4, 4]."""
        return rigid_inverse(self.world_from_cam)

    def camera_of(self, index: int) -> Camera:
        """The camera that took image ``index``."""
        return self.cameras[self.images[index].camera]

    def landmarks(self) -> Iterator[Landmark]:
        """All points of the model."""
        points, row_of = self.model.points, {number: row for row, number in enumerate(self.image_ids)}
        columns = (points.ids, points.xyz, points.rgb, points.track_starts, points.track_starts[1:])
        images, features = points.track_image_ids.tolist(), points.track_point2d_indices.tolist()
        for number, xyz, rgb, start, end in zip(*(column.tolist() for column in columns), strict=False):
            shown = [
                (row_of[image], feature, self.model.images[image].points2d_px[feature].tolist())
                for image, feature in zip(images[start:end], features[start:end], strict=True)
                if image in row_of
            ]
            yield Landmark(number, xyz, rgb, shown)

    def of_body(self, offset: BodyOffset) -> RefinedSet:
        """The set with the poses of the camera's body; without points, rigs and bounds of the cameras."""
        cam_from_body = rigid_inverse(offset.body_from_cam)
        images = tuple(
            replace(
                image,
                world_from_cam=image.world_from_cam @ cam_from_body,
                given=None if image.given is None else image.given @ cam_from_body,
                uncertainty=None,
            )
            for image in self.images
        )
        poses = np.stack([image.world_from_cam for image in images])
        names, lenses = [image.file_name for image in images], [image.camera for image in images]
        return replace(
            self,
            images=images,
            model=model_of_poses(names, self.cameras, lenses, poses),
            image_ids=tuple(range(1, len(images) + 1)),
            points_source="none",
            body_offset=None,
        )


def refined_set(
    dataset: Dataset,
    world_from_cam: NDArray[np.float64],
    *,
    given: Sequence[NDArray[np.float64] | None] | None = None,
    similarity: Similarity | None = None,
    pose_sources: Sequence[str] | None = None,
    flags: Sequence[tuple[str, ...]] | None = None,
    uncertainty: Sequence[PoseUncertainty | None] | None = None,
    body_offset: BodyOffset | None = None,
) -> RefinedSet:
    """The set of ``dataset`` at refined poses [n, 4, 4], without points; what is left out is unknown or none.

    Where the input was a COLMAP model, its ids, rigs and features are kept.

    Args:
        given: the poses before; those of the dataset where left out.

    Raises:
        ValueError: poses are not finite or not of all images.
    """
    count = len(dataset)
    if world_from_cam.shape != (count, 4, 4) or not np.isfinite(world_from_cam).all():
        raise ValueError(f"poses must be finite and of shape ({count}, 4, 4), not {world_from_cam.shape}")
    before = [frame.world_from_cam for frame in dataset.frames] if given is None else list(given)
    sources = pose_sources or [frame.pose_source or "none" for frame in dataset.frames]
    marks = flags or [()] * count
    known = uncertainty or [None] * count
    images = tuple(
        RefinedImage(
            frame.name,
            file_name,
            frame.camera,
            pose,
            before[i],
            sources[i],
            marks[i],
            frame.path,
            frame.orientation,
            known[i],
            frame.levels,
        )
        for i, (frame, file_name, pose) in enumerate(
            zip(dataset.frames, dataset.file_names, np.asarray(world_from_cam, np.float64), strict=True)
        )
    )
    model, image_ids = _model(dataset, before, world_from_cam)
    return RefinedSet(
        dataset.cameras,
        images,
        model,
        image_ids,
        "none",
        similarity or Similarity.identity(),
        _times(dataset),
        body_offset,
    )


def of_whole(
    dataset: Dataset, world_from_cam: NDArray[np.float64], similarity: Similarity
) -> tuple[Dataset, RefinedSet] | None:
    """The set as it was before panoramas were cut, and that at the poses [n, 4, 4] of the views; None without any.

    Photos that are no panoramas have the lenses of ``dataset``.
    """
    if dataset.cut is None:
        return None
    whole = dataset.cut.whole
    cameras = list(whole.cameras)
    for frame, row in zip(dataset.frames, dataset.cut.rows, strict=True):
        lens = whole.frames[row].camera
        if not cameras[lens].panorama:
            cameras[lens] = dataset.cameras[frame.camera]
    whole = replace(whole, cameras=tuple(cameras))
    return whole, refined_set(whole, dataset.cut.poses_of_whole(world_from_cam), similarity=similarity)


def _model(
    dataset: Dataset, before: Sequence[NDArray[np.float64] | None], world_from_cam: NDArray[np.float64]
) -> tuple[ColmapModel, tuple[int, ...]]:
    """The set as a COLMAP model without points, the caller's own where the input was one, and the images' ids."""
    indices = [frame.camera for frame in dataset.frames]
    given = dataset.source.colmap
    if given is None:
        made = model_of_poses(dataset.file_names, dataset.cameras, indices, world_from_cam)
        if dataset.cut is not None:
            rigs = [dataset.cut.whole.frames[row].camera for row in dataset.cut.rows]
            made = with_rigs(made, rigs, dataset.cut.rows, dataset.cut.cam_from_whole)
        return made, tuple(range(1, len(dataset) + 1))
    as_read = dataset.body_offset is None
    changed = np.array(
        [
            not (as_read and old is not None and np.array_equal(old, new))
            for old, new in zip(before, world_from_cam, strict=True)
        ]
    )
    moved = model_at_poses(given, dataset.names, dataset.cameras, indices, world_from_cam, changed)
    model = with_points(moved, no_points())  # the given ones belong to the poses before
    id_of_name = {image.name: image.id for image in model.images.values()}
    return model, tuple(id_of_name[name] for name in dataset.names)


def _times(dataset: Dataset) -> tuple[float, ...] | None:
    """When the images were taken, if the input gives it for all of them."""
    times = tuple(frame.timestamp_s for frame in dataset.frames if frame.timestamp_s is not None)
    return times if len(times) == len(dataset) else None
