"""Small readers of the formats, written from the formats' rules, independently of the writers, with projections.

Each reader gives, for image i in the caller's order, a function from points in the world [m, 3] to pixels [m, 2].
"""

from __future__ import annotations

import json
import struct

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from biresnerf.geometry.camera.camera import Intrinsics, project


def ours(refined, index, points):
    """What the library itself projects."""
    pose = refined.world_from_cam[index]
    in_cam = (points - pose[:3, 3]) @ pose[:3, :3]
    lens = Intrinsics.from_cameras([refined.camera_of(index)])
    return project(lens, torch.zeros(len(points), dtype=torch.int64), torch.from_numpy(in_cam)).numpy()


def seen_points(refined, index, count=40, seed=0):
    """Points in the world that camera ``index`` sees, spread over its image."""
    rng = np.random.default_rng([seed, index])
    camera = refined.camera_of(index)
    full = camera.full()
    xy = rng.uniform(0.05, 0.95, (count, 2)) * [camera.width, camera.height]
    depth = rng.uniform(2.0, 6.0, (count, 1))
    in_cam = np.hstack([(xy - [full.cx, full.cy]) / [full.fx, full.fy], np.ones((count, 1))]) * depth
    pose = refined.world_from_cam[index]
    return in_cam @ pose[:3, :3].T + pose[:3, 3]


def through_json_frame(document, frame, points):
    """A transforms.json frame as nerfstudio and instant-ngp take it: OpenGL axes, OPENCV or OPENCV_FISHEYE."""
    values = {**{k: v for k, v in document.items() if k != "frames"}, **frame}
    matrix = np.eye(4)
    matrix[: len(frame["transform_matrix"])] = frame["transform_matrix"]
    x, y, z = ((points - matrix[:3, 3]) @ matrix[:3, :3] * [1, -1, -1]).T
    k1, k2, k3, k4, p1, p2 = (values.get(key, 0.0) for key in ("k1", "k2", "k3", "k4", "p1", "p2"))
    u, v = x / z, y / z
    if values.get("is_fisheye") or values.get("camera_model") == "OPENCV_FISHEYE":
        r = np.hypot(u, v)
        t = np.arctan(r)
        bent = t * (1 + k1 * t**2 + k2 * t**4 + k3 * t**6 + k4 * t**8) / r
        u, v = u * bent, v * bent
    else:
        r2 = u * u + v * v
        radial = 1 + r2 * (k1 + r2 * (k2 + r2 * (k3 + r2 * k4)))
        u, v = (
            u * radial + 2 * p1 * u * v + p2 * (r2 + 2 * u * u),
            v * radial + 2 * p2 * u * v + p1 * (r2 + 2 * v * v),
        )
    return np.stack([values["fl_x"] * u + values["cx"], values["fl_y"] * v + values["cy"]], 1)


def bundler_cameras(path):
    """(f, k1, k2, R, t) of each camera and (xyz, rgb, views) of each point of a bundle.out."""
    words = iter(path.read_text().split("\n", 1)[1].split())

    def take(n):
        return [float(next(words)) for _ in range(n)]

    cameras, points = (int(v) for v in take(2))
    poses = [(*take(3), np.array(take(9)).reshape(3, 3), np.array(take(3))) for _ in range(cameras)]
    tracks = []
    for _ in range(points):
        xyz, rgb, number = take(3), take(3), int(take(1)[0])
        tracks.append((xyz, rgb, np.array(take(4 * number)).reshape(number, 4)))
    assert next(words, None) is None
    return poses, tracks


def through_bundler(camera, size, points):
    """By the manual: P = R X + t; p = -P / P.z; p' = f (1 + k1 |p|^2 + k2 |p|^4) p, y up from the centre."""
    f, k1, k2, rotation, translation = camera
    p = points @ rotation.T + translation
    xy = -p[:, :2] / p[:, 2:]
    r2 = (xy**2).sum(1, keepdims=True)
    xy = f * (1 + k1 * r2 + k2 * r2**2) * xy
    return np.stack([size[0] / 2 + xy[:, 0], size[1] / 2 - xy[:, 1]], 1)


def tum_poses(path):
    """Times and world_from_cam [n, 4, 4] of a TUM file, as evo reads it: comments skipped, scalar last."""
    rows = np.loadtxt(path, comments="#", ndmin=2)
    poses = np.tile(np.eye(4), (len(rows), 1, 1))
    poses[:, :3, :3] = Rotation.from_quat(rows[:, 4:]).as_matrix()
    poses[:, :3, 3] = rows[:, 1:4]
    return rows[:, 0], poses


def glb_parts(path):
    """The JSON and the binary chunk of a GLB file, its frame checked by the specification."""
    data = path.read_bytes()
    magic, version, length = struct.unpack_from("<4sII", data)
    assert (magic, version, length) == (b"glTF", 2, len(data))
    json_length, kind = struct.unpack_from("<I4s", data, 12)
    assert kind == b"JSON"
    assert json_length % 4 == 0
    binary_length, kind = struct.unpack_from("<I4s", data, 20 + json_length)
    assert kind == b"BIN\0"
    assert binary_length % 4 == 0
    assert 28 + json_length + binary_length == len(data)
    return json.loads(data[20 : 20 + json_length]), data[28 + json_length :]


def glb_accessor(document, binary, index):
    """The values of an accessor, with what the specification asks of it checked."""
    accessor = document["accessors"][index]
    view = document["bufferViews"][accessor["bufferView"]]
    dtype = {5121: np.dtype("u1"), 5125: np.dtype("<u4"), 5126: np.dtype("<f4")}[accessor["componentType"]]
    width = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}[accessor["type"]]
    size = accessor["count"] * width * dtype.itemsize
    assert view["buffer"] == 0
    assert view["byteOffset"] % 4 == 0
    assert width * dtype.itemsize % 4 == 0
    assert size == view["byteLength"]
    assert view["byteOffset"] + size <= document["buffers"][0]["byteLength"] <= len(binary)
    values = np.frombuffer(binary, dtype, accessor["count"] * width, view["byteOffset"])
    return values.reshape(accessor["count"], width)
