"""COLMAP's binary model, written without COLMAP; rigs and frames too, where the model has them.

Layouts: src/colmap/scene/reconstruction_io_binary.cc; little-endian throughout.
"""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np

from biresnerf.data.model.atomic_file import whole_file
from biresnerf.data.model.colmap_scene import SENSOR_TYPES, ColmapModel, RigidPose, Sensor
from biresnerf.geometry.camera.camera_models import MODEL_IDS

_OBSERVATION = np.dtype([("xy", "<f8", 2), ("id", "<u8")])


def write_colmap_binary(model: ColmapModel, folder: Path) -> None:
    """Writes the model's files into ``folder``, each whole or not at all (COLMAP wants ``sparse/0``).

    Raises:
        ValueError: a name that the tables cannot hold.
    """
    if any("\0" in image.name or not image.name for image in model.images.values()):
        raise ValueError("image names must not be empty and not hold NUL")
    for table in model.tables:
        with whole_file(folder / f"{table}.bin") as temporary:
            temporary.write_bytes(_TABLES[table](model))


def _cameras(model: ColmapModel) -> bytes:
    parts = [struct.pack("<Q", len(model.cameras))]
    for number, camera in model.cameras.items():
        parts.append(struct.pack("<IiQQ", number, MODEL_IDS[camera.model], camera.width, camera.height))
        parts.append(struct.pack(f"<{len(camera.params)}d", *camera.params))
    return b"".join(parts)


def _images(model: ColmapModel) -> bytes:
    parts = [struct.pack("<Q", len(model.images))]
    for number, image in model.images.items():
        parts.append(
            struct.pack("<I", number) + _pose(image.cam_from_world) + struct.pack("<I", image.camera_id)
        )
        observations = np.zeros(len(image.points2d_px), _OBSERVATION)
        observations["xy"] = image.points2d_px
        observations["id"] = image.point3d_ids.astype(np.uint64)  # no point, -1, becomes COLMAP's 2^64 - 1
        parts.append(image.name.encode() + b"\0" + struct.pack("<Q", len(observations)))
        parts.append(observations.tobytes())
    return b"".join(parts)


def _points(model: ColmapModel) -> bytes:
    points = model.points
    parts = [struct.pack("<Q", len(points))]
    tracks = np.stack([points.track_image_ids, points.track_point2d_indices], axis=1).astype("<u4")
    for k in range(len(points)):
        track = tracks[points.track_starts[k] : points.track_starts[k + 1]]
        parts.append(struct.pack("<Q3d", int(points.ids[k]), *points.xyz[k]) + points.rgb[k].tobytes())
        parts.append(struct.pack("<dQ", points.errors[k], len(track)) + track.tobytes())
    return b"".join(parts)


def _rigs(model: ColmapModel) -> bytes:
    parts = [struct.pack("<Q", len(model.rigs))]
    for number, rig in model.rigs.items():
        if rig.reference is None:
            parts.append(struct.pack("<II", number, 0))
            continue
        parts.append(struct.pack("<II", number, 1 + len(rig.sensor_from_rig)) + _sensor(rig.reference))
        for sensor, sensor_from_rig in rig.sensor_from_rig.items():
            parts.append(_sensor(sensor) + struct.pack("<B", sensor_from_rig is not None))
            if sensor_from_rig is not None:
                parts.append(_pose(sensor_from_rig))
    return b"".join(parts)


def _frames(model: ColmapModel) -> bytes:
    parts = [struct.pack("<Q", len(model.frames))]
    for number, frame in model.frames.items():
        parts.append(struct.pack("<II", number, frame.rig_id) + _pose(frame.rig_from_world))
        parts.append(struct.pack("<I", len(frame.data_ids)))
        parts += [_sensor(sensor) + struct.pack("<Q", data_id) for sensor, data_id in frame.data_ids]
    return b"".join(parts)


def _sensor(sensor: Sensor) -> bytes:
    return struct.pack("<iI", SENSOR_TYPES.index(sensor[0]), sensor[1])


def _pose(pose: RigidPose) -> bytes:
    return struct.pack("<7d", *pose.quat_wxyz, *pose.translation)


_TABLES = {"points3D": _points, "cameras": _cameras, "images": _images, "rigs": _rigs, "frames": _frames}
