"""Writers of capture and benchmark formats, by their programs' rules: five random poses and a lens each.

Each writes the pose files into a folder and returns what they hold; photos are written apart.
"""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from biresnerf.geometry.camera.camera_models import Camera
from tests.data.formats.posed_sets import renamed
from tests.data.formats.random_sets import random_result
from tests.data.scenes import write_image

FLIP = np.diag([1.0, -1.0, -1.0, 1.0])
PINHOLE = Camera("PINHOLE", 64, 48, (70.0, 72.0, 31.0, 25.5))


def result(names: str, lens: Camera = PINHOLE):
    """Five images by one camera, under ``names`` with their number."""
    refined = renamed(random_result(3, model=lens.model), [names.format(i) for i in range(5)])
    return replace(refined, cameras=(lens,) * len(refined.cameras))


def matrix_of(lens: Camera, first_pixel: float) -> np.ndarray:
    full, shift = lens.full(), 0.5 - first_pixel
    return np.array([[full.fx, 0, full.cx - shift], [0, full.fy, full.cy - shift], [0, 0, 1.0]])


def dump(path: Path, value) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(value if isinstance(value, str) else json.dumps(value))


def record3d(folder: Path, name="metadata.json", photos="rgb/{}.jpg", per_frame=True):
    """nerfstudio: quaternion with the scalar last, OpenGL axes, K by columns."""
    refined = result(photos)
    rows = []
    for pose in refined.world_from_cam:
        opengl = pose @ FLIP
        rows.append([*Rotation.from_matrix(opengl[:3, :3]).as_quat().tolist(), *opengl[:3, 3].tolist()])
    k = matrix_of(PINHOLE, 0.5)
    document = {"w": 64, "h": 48, "K": k.T.ravel().tolist(), "fps": 60, "poses": rows}
    if per_frame:
        document["K"] = (3 * k).T.ravel().tolist()
        document["perFrameIntrinsicCoeffs"] = [[70.0, 72.0, 31.0, 25.5]] * 5
    dump(folder / name, document)
    return refined


def polycam(
    folder: Path,
    cameras="keyframes/corrected_cameras",
    photos="keyframes/corrected_images/{}.jpg",
    size=(("width", 64), ("height", 48)),
):
    """nerfstudio, but for its exchange of the world's axes: OpenGL axes by rows, in ARKit's world."""
    refined = result(photos)
    for index, pose in enumerate(refined.world_from_cam):
        opengl = pose @ FLIP
        values = {f"t_{row}{column}": opengl[row, column] for row in range(3) for column in range(4)}
        lens = {"fx": 70.0, "fy": 72.0, "cx": 31.0, "cy": 25.5, "blur_score": 90, **dict(size)}
        dump(folder / cameras / f"{index}.json", lens | values)
    return refined


def scanner_app(folder: Path):
    """A real capture: OpenGL axes by rows; the lens is of a larger picture, whose size the projection tells."""
    refined = result("frame_{:05}.jpg")
    for index, pose in enumerate(refined.world_from_cam):
        frame = {
            "cameraPoseARFrame": (pose @ FLIP).ravel().tolist(),
            "intrinsics": [210.0, 0, 93.0, 0, 216.0, 76.5, 0, 0, 1],
            "projectionMatrix": [420 / 192, 0, 0, 0, 0, 432 / 144, *[0] * 10],
        }
        dump(folder / f"frame_{index:05}.json", frame)
        write_image(folder / f"depth_{index:05}.png", index, mode="L")
        for more in range(2):  # frames without a photo
            dump(folder / f"frame_{5 + 2 * index + more:05}.json", frame)
    return refined


def realestate10k(folder: Path, times=True):
    """Its description: shares of the width and height, world to camera."""
    refined = result("frames/{}.jpg")
    stamps = [46_012_000 + 33_367 * index for index in range(5)] if times else range(5)
    refined = renamed(refined, [f"frames/{stamp}.jpg" for stamp in stamps])
    lines = ["https://www.youtube.com/watch?v=x"]
    for stamp, pose in zip(stamps, refined.world_from_cam, strict=True):
        lens = [70 / 64, 72 / 48, 31 / 64, 25.5 / 48, 0, 0]
        values = [*lens, *np.linalg.inv(pose)[:3].ravel().tolist()]
        lines.append(" ".join([str(stamp if times else 1000 * stamp), *map(repr, values)]))
    dump(folder / "000c3ab189999a83.txt", "\n".join(lines) + "\n")
    return refined


def mvsnet(folder: Path):
    """write_cam of MVSNet; its grid of pixels begins at 0.5."""
    refined = result("images/{:08}.jpg")
    for index, pose in enumerate(refined.world_from_cam):
        lines = ["extrinsic", *(" ".join(map(repr, row)) + " " for row in np.linalg.inv(pose).tolist()), ""]
        lines += ["intrinsic", *(" ".join(map(repr, row)) + " " for row in matrix_of(PINHOLE, 0.5).tolist())]
        dump(folder / f"cams/{index:08}_cam.txt", "\n".join([*lines, "", "425.0 2.5 192 935.0", ""]))
    dump(folder / "pair.txt", "5\n")
    return refined


def bop(folder: Path):
    """BOP's description; its pixels are indices."""
    refined = result("rgb/{:06}.png")
    cameras = {}
    for index, pose in enumerate(refined.world_from_cam):
        w2c = np.linalg.inv(pose)
        cameras[str(index)] = {
            "cam_K": matrix_of(PINHOLE, 0.0).ravel().tolist(), "depth_scale": 1.0,
            "cam_R_w2c": w2c[:3, :3].ravel().tolist(), "cam_t_w2c": w2c[:3, 3].tolist(),
        }  # fmt: skip
        write_image(folder / f"depth/{index:06}.png", index, mode="L")
    dump(folder / "scene_camera.json", cameras)
    return refined


def sdfstudio(folder: Path):
    """sdfstudio's parser takes camtoworld for OpenCV's."""
    refined = result("{:06}_rgb.png")
    k = np.eye(4)
    k[:3, :3] = matrix_of(PINHOLE, 0.5)
    frames = [
        {"rgb_path": f"{i:06}_rgb.png", "camtoworld": pose.tolist(), "intrinsics": k.tolist()}
        for i, pose in enumerate(refined.world_from_cam)
    ]
    for index in range(5):
        write_image(folder / f"{index:06}_normal.png", index)
    head = {"camera_model": "OPENCV", "height": 48, "width": 64, "scene_box": {"aabb": [[-1] * 3, [1] * 3]}}
    dump(folder / "meta_data.json", head | {"frames": frames})
    return refined


DISTORTED = Camera(
    "FULL_OPENCV", 64, 48, (70.0, 77.0, 31.0, 25.5, 0.02, -0.01, 0.003, -0.002, 0.004, 0, 0, 0)
)


def nerfies(folder: Path, key="tangential_distortion"):
    """Camera.project of nerfies; its pixels' centres are at 0.5."""
    refined = result("rgb/1x/{:06}.png", DISTORTED)
    for index, pose in enumerate(refined.world_from_cam):
        camera = {
            "orientation": pose[:3, :3].T.tolist(), "position": pose[:3, 3].tolist(), "focal_length": 70.0,
            "principal_point": [31.0, 25.5], "skew": 0.0, "pixel_aspect_ratio": 1.1,
            "radial_distortion": [0.02, -0.01, 0.004], key: [0.003, -0.002], "image_size": [64, 48],
        }  # fmt: skip
        dump(folder / f"camera/{index:06}.json", camera)
        write_image(folder / f"rgb/2x/{index:06}.png", index, (32, 24))
    dump(folder / "dataset.json", {"ids": []})
    return refined


def tanks_and_temples(folder: Path):
    """write_SfM_log of the toolbox; no lenses."""
    refined = result("images/{:06}.jpg")
    lines = []
    for index, pose in enumerate(refined.world_from_cam):
        lines += [f"{index} {index} 0", *(" ".join(map(repr, row)) for row in pose.tolist())]
    dump(folder / "Ignatius_COLMAP_SfM.log", "\n".join(lines) + "\n")
    return refined


SENSOR = """#General sensor definitions.
sensor_type: camera
# Sensor extrinsics wrt. the body-frame.
T_BS:
  cols: 4
  rows: 4
  data: [{matrix}]
rate_hz: 20
resolution: [64, 48]
camera_model: pinhole
intrinsics: [70.0, 72.0, 30.5, 25.0] #fu, fv, cu, cv
distortion_model: {model}
distortion_coefficients: [0.02, -0.01, 0.003, -0.002]
"""


def euroc(folder: Path, model="radial-tangential", above="mav0/"):
    """The head of the csv and the comments of sensor.yaml say what is what."""
    start, period = 1403715523912143104, 50_000_000
    fisheye = model == "equidistant"
    lens = Camera(
        "OPENCV_FISHEYE" if fisheye else "OPENCV", 64, 48, (70, 72, 31, 25.5, 0.02, -0.01, 0.003, -0.002)
    )
    refined = result(above + "cam0/data/{}.png", lens)
    refined = renamed(refined, [f"{above}cam0/data/{start + i * period}.png" for i in range(5)])
    body_from_cam = np.eye(4)
    body_from_cam[:3, :3] = Rotation.from_euler("zyx", [90, 2, -1], degrees=True).as_matrix()
    body_from_cam[:3, 3] = [-0.02, -0.06, 0.01]
    lines = [
        "#timestamp, p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], q_RS_y [], q_RS_z [], v"
    ]
    for index, pose in enumerate(refined.world_from_cam):
        for offset in (-5_000_000, 64, 5_000_000):
            body = pose @ np.linalg.inv(body_from_cam)
            x, y, z, w = Rotation.from_matrix(body[:3, :3]).as_quat()
            centre = body[:3, 3] + offset * 1e-9 * (offset != 64)
            values = [*centre.tolist(), *map(float, (w, x, y, z)), 0.0, 0.0, 0.0]
            lines.append(",".join([str(start + index * period + offset), *map(repr, values)]))
    dump(folder / above / "state_groundtruth_estimate0/data.csv", "\n".join(lines) + "\n")
    matrix = re.sub(r"\s+", " ", ",\n".join(map(repr, body_from_cam.ravel().tolist())))
    dump(folder / above / "cam0/sensor.yaml", SENSOR.format(matrix=matrix, model=model))
    return refined
