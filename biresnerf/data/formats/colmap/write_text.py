"""COLMAP's text model. It cannot hold names with spaces: every reader of it cuts them at the first one.

Layouts: src/colmap/scene/reconstruction_io_text.cc. Numbers are written with all their digits.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path

from biresnerf.data.formats.codec import cannot_hold
from biresnerf.data.model.atomic_file import write_text
from biresnerf.data.model.colmap_scene import ColmapModel, RigidPose, Sensor


def write_colmap_text(model: ColmapModel, folder: Path) -> None:
    """Writes cameras.txt, images.txt, points3D.txt and, where the model has them, rigs.txt and frames.txt.

    Raises:
        InputError: ``export_not_possible``: a name that the tables cannot hold.
    """
    for image in model.images.values():
        if len(image.name.split()) != 1 or image.name.startswith("#"):
            raise cannot_hold(
                "colmap-text",
                f"COLMAP's text tables cannot hold this model: the name {image.name!r} has a space in it, and every "
                "reader of the text tables cuts it there.",
                "Use the binary model in colmap/sparse/0, or rename the image.",
            )
    for table in model.tables:
        write_text(folder / f"{table}.txt", "\n".join(_TABLES[table](model)))


def _cameras(model: ColmapModel) -> Iterator[str]:
    yield "# CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]"
    for number, camera in model.cameras.items():
        yield f"{number} {camera.model} {camera.width} {camera.height} {_numbers(camera.params)}"


def _images(model: ColmapModel) -> Iterator[str]:
    yield "# IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME"
    yield "# POINTS2D[] as (X, Y, POINT3D_ID)"
    for number, image in model.images.items():
        yield f"{number} {_pose(image.cam_from_world)} {image.camera_id} {image.name}"
        seen = zip(image.points2d_px.tolist(), image.point3d_ids.tolist(), strict=True)
        yield " ".join(f"{_numbers(xy)} {point}" for xy, point in seen)


def _points(model: ColmapModel) -> Iterator[str]:
    points = model.points
    yield "# POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[] as (IMAGE_ID, POINT2D_IDX)"
    for k in range(len(points)):
        track = slice(int(points.track_starts[k]), int(points.track_starts[k + 1]))
        elements = zip(
            points.track_image_ids[track].tolist(), points.track_point2d_indices[track].tolist(), strict=True
        )
        colour = " ".join(str(value) for value in points.rgb[k].tolist())
        seen = " ".join(f"{image} {feature}" for image, feature in elements)
        yield f"{points.ids[k]} {_numbers(points.xyz[k].tolist())} {colour} {float(points.errors[k])!r} {seen}"


def _rigs(model: ColmapModel) -> Iterator[str]:
    yield "# RIG_ID, NUM_SENSORS, REF_SENSOR_TYPE, REF_SENSOR_ID, SENSORS[] as"
    yield "# (SENSOR_TYPE, SENSOR_ID, HAS_POSE, [QW, QX, QY, QZ, TX, TY, TZ])"
    for number, rig in model.rigs.items():
        words = [str(number), str((rig.reference is not None) + len(rig.sensor_from_rig))]
        words += [] if rig.reference is None else [_sensor(rig.reference)]
        for sensor, pose in rig.sensor_from_rig.items():
            words += [_sensor(sensor), "0" if pose is None else f"1 {_pose(pose)}"]
        yield " ".join(words)


def _frames(model: ColmapModel) -> Iterator[str]:
    yield "# FRAME_ID, RIG_ID, RIG_FROM_WORLD[QW, QX, QY, QZ, TX, TY, TZ], NUM_DATA_IDS,"
    yield "# DATA_IDS[] as (SENSOR_TYPE, SENSOR_ID, DATA_ID)"
    for number, frame in model.frames.items():
        taken = " ".join(f"{_sensor(sensor)} {data_id}" for sensor, data_id in frame.data_ids)
        yield f"{number} {frame.rig_id} {_pose(frame.rig_from_world)} {len(frame.data_ids)} {taken}"


def _sensor(sensor: Sensor) -> str:
    return f"{sensor[0]} {sensor[1]}"


def _pose(pose: RigidPose) -> str:
    return _numbers([*pose.quat_wxyz.tolist(), *pose.translation.tolist()])


def _numbers(values: Iterable[float]) -> str:
    return " ".join(repr(float(value)) for value in values)


_TABLES = {"points3D": _points, "cameras": _cameras, "images": _images, "rigs": _rigs, "frames": _frames}
