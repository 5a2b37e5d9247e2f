"""A result as a COLMAP model: the caller's ids, cameras, rigs and frames where the input was a COLMAP model."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from biresnerf.data.model import colmap_scene as colmap
from biresnerf.geometry.camera.camera_models import Camera
from biresnerf.geometry.rigid import rigid_inverse


def model_of_poses(
    names: Sequence[str],
    cameras: Sequence[Camera],
    camera_indices: Sequence[int],
    world_from_cam: NDArray[np.float64],
) -> colmap.ColmapModel:
    """A model without points or rigs; ids are positions counted from 1."""
    cam_from_world = rigid_inverse(world_from_cam)
    images = {
        number: _without_observations(number, name, camera + 1, colmap.rigid_pose_of(pose))
        for number, (name, camera, pose) in enumerate(
            zip(names, camera_indices, cam_from_world, strict=True), start=1
        )
    }
    return colmap.ColmapModel(
        Path(), "binary", dict(enumerate(cameras, start=1)), images, colmap.no_points(), {}, {}
    )


def with_rigs(
    model: colmap.ColmapModel,
    rigs: Sequence[int],
    moments: NDArray[np.int64],
    cam_from_rig: NDArray[np.float64],
) -> colmap.ColmapModel:
    """A model of `model_of_poses` as rigs.

    Args:
        rigs: of each image, the number of its rig.
        moments: of each image, int64 [n]: those of one number were taken at once.
        cam_from_rig: of each image's camera, float64 [n, 4, 4].
    """
    sensors: dict[int, dict[colmap.Sensor, NDArray[np.float64]]] = {}
    frames: dict[int, tuple[int, list[tuple[colmap.Sensor, int]]]] = {}
    for image, rig, moment, pose in zip(
        model.images.values(), rigs, moments.tolist(), cam_from_rig, strict=True
    ):
        sensor: colmap.Sensor = ("CAMERA", image.camera_id)
        sensors.setdefault(rig, {})[sensor] = pose
        frames.setdefault(moment, (rig, []))[1].append((sensor, image.id))
    made = {}
    for rig, ((first, reference), *others) in ((rig, [*found.items()]) for rig, found in sensors.items()):
        known: dict[colmap.Sensor, colmap.RigidPose | None] = {
            one: colmap.rigid_pose_of(pose @ rigid_inverse(reference)) for one, pose in others
        }
        made[rig + 1] = colmap.ColmapRig(rig + 1, first, known)
    placed = {}
    for moment, (rig, taken) in frames.items():
        rig_from_world = _rig_from_world(made[rig + 1], taken, model.images)
        assert rig_from_world is not None, "every sensor's place in its rig is known"
        placed[moment + 1] = colmap.ColmapFrame(moment + 1, rig + 1, rig_from_world, tuple(taken))
    return replace(model, rigs=made, frames=placed)


def model_at_poses(
    given: colmap.ColmapModel,
    names: Sequence[str],
    cameras: Sequence[Camera],
    camera_indices: Sequence[int],
    world_from_cam: NDArray[np.float64],
    changed: NDArray[np.bool_],
) -> colmap.ColmapModel:
    """The caller's model with refined poses and lenses; all ids, names, features and points as given.

    Images that did not change (``changed`` [n] false) keep their numbers to the bit. Images that the model did not
    have get new ids behind the last ones, and a frame each where the model has frames. Points are the given ones: the
    caller must correct them (`biresnerf.data.points.refined_points`).

    Args:
        given: the caller's model.
        names: of the images in it.
        cameras, camera_indices: lenses after the refinement, and which took each image.
        world_from_cam: float64 [n, 4, 4].
    """
    cam_from_world = rigid_inverse(world_from_cam)
    by_name = {image.name: image for image in given.images.values()}
    lenses, images = dict(given.cameras), dict(given.images)
    lens_ids: dict[int, int] = {}  # by index into cameras
    for name, index in zip(names, camera_indices, strict=True):
        if name in by_name:
            number = by_name[name].camera_id
            lenses[number], lens_ids[index] = cameras[index], number
    for row, (name, index) in enumerate(zip(names, camera_indices, strict=True)):
        pose = colmap.rigid_pose_of(cam_from_world[row])
        image = by_name.get(name)
        if image is None:
            if index not in lens_ids:
                lens_ids[index] = max(lenses) + 1
                lenses[lens_ids[index]] = cameras[index]
            number = max(images) + 1
            images[number] = _without_observations(number, name, lens_ids[index], pose)
        elif changed[row]:
            images[image.id] = replace(image, cam_from_world=pose)
    moved = {
        by_name[name].id for name, new in zip(names, changed.tolist(), strict=True) if new and name in by_name
    }
    rigs, frames = _rigs_and_frames(given, images, moved)
    return replace(given, cameras=lenses, images=images, rigs=rigs, frames=frames)


def _without_observations(
    number: int, name: str, camera_id: int, pose: colmap.RigidPose
) -> colmap.ColmapImage:
    return colmap.ColmapImage(number, name, camera_id, pose, np.zeros((0, 2)), np.zeros(0, np.int64))


def _rigs_and_frames(
    given: colmap.ColmapModel, images: dict[int, colmap.ColmapImage], moved: set[int]
) -> tuple[dict[int, colmap.ColmapRig], dict[int, colmap.ColmapFrame]]:
    """The given frames at their images' new poses, and one more for each image that had none."""
    if not given.rigs:
        return {}, {}
    rigs, frames = dict(given.rigs), {}
    placed: set[int] = set()
    for number, frame in given.frames.items():
        taken = [(sensor, image) for sensor, image in frame.data_ids if sensor[0] == "CAMERA"]
        placed.update(image for _, image in taken)
        pose = frame.rig_from_world
        if any(image in moved for _, image in taken):
            pose = _rig_from_world(rigs[frame.rig_id], taken, images) or pose
        frames[number] = replace(frame, rig_from_world=pose)
    for image in images.values():
        if image.id in placed:
            continue
        sensor: colmap.Sensor = ("CAMERA", image.camera_id)
        rig = next(
            (rig for rig in rigs.values() if sensor == rig.reference or sensor in rig.sensor_from_rig), None
        )
        if rig is None:
            rig = colmap.ColmapRig(max(rigs) + 1, sensor, {})
            rigs[rig.id] = rig
        new_pose = _rig_from_world(rig, [(sensor, image.id)], images)
        if new_pose is None:  # a sensor of unknown pose in its rig: COLMAP cannot represent this
            continue
        number = max(frames, default=0) + 1
        frames[number] = colmap.ColmapFrame(number, rig.id, new_pose, ((sensor, image.id),))
    return rigs, frames


def _rig_from_world(
    rig: colmap.ColmapRig, taken: Sequence[tuple[colmap.Sensor, int]], images: dict[int, colmap.ColmapImage]
) -> colmap.RigidPose | None:
    """The rig's pose from the image of its reference sensor, else of the first sensor with a known pose in the rig."""
    for sensor, image in taken:
        if sensor == rig.reference:
            return images[image].cam_from_world
    for sensor, image in taken:
        sensor_from_rig = rig.sensor_from_rig.get(sensor)
        if sensor_from_rig is not None:
            rig_from_sensor = rigid_inverse(colmap.matrix_of_pose(sensor_from_rig))
            return colmap.rigid_pose_of(rig_from_sensor @ colmap.matrix_of_pose(images[image].cam_from_world))
    return None


def with_points(model: colmap.ColmapModel, points: colmap.ColmapPoints) -> colmap.ColmapModel:
    """The model with other points: features stay, and say which of these points they see."""
    ids = {number: np.full(len(image.point3d_ids), colmap.NO_POINT) for number, image in model.images.items()}
    owners = np.repeat(points.ids, np.diff(points.track_starts))
    for owner, image, feature in zip(
        owners.tolist(), points.track_image_ids.tolist(), points.track_point2d_indices.tolist(), strict=True
    ):
        ids[image][feature] = owner
    images = {number: replace(image, point3d_ids=ids[number]) for number, image in model.images.items()}
    return replace(model, images=images, points=points)
