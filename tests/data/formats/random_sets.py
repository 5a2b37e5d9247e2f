"""Random results and models, of every camera model."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from biresnerf.data.model.colmap_scene import (
    ColmapFrame,
    ColmapImage,
    ColmapModel,
    ColmapPoints,
    ColmapRig,
    matrix_of_pose,
    rigid_pose_of,
)
from biresnerf.data.model.refined_set import RefinedImage, RefinedSet
from biresnerf.data.model.result_model import model_of_poses, with_points
from biresnerf.geometry.camera.camera_models import MODEL_PARAMETERS, Camera
from biresnerf.geometry.rigid import rigid_inverse
from biresnerf.geometry.similarity import Similarity

WIDTH, HEIGHT = 64, 48
# About which the parameters lie that are no coefficients.
SHAPES = {"omega": 0.8, "alpha": 0.6, "beta": 1.1}


def random_camera(
    rng: np.random.Generator, model: str | None = None, size: tuple[int, int] = (WIDTH, HEIGHT)
) -> Camera:
    """A camera with every coefficient of its model in use, all small."""
    chosen = model or str(rng.choice(sorted(MODEL_PARAMETERS)))
    width, height = size
    values = {"cx": width / 2 + rng.uniform(-3, 3), "cy": height / 2 + rng.uniform(-3, 3)}
    params = []
    for name in MODEL_PARAMETERS[chosen]:
        if name.startswith("f"):
            params.append(width * rng.uniform(0.9, 1.3))
        else:
            params.append(values.get(name, SHAPES.get(name, 0.0) + rng.uniform(-0.01, 0.01)))
    return Camera(chosen, width, height, tuple(float(value) for value in params))


def random_poses(rng: np.random.Generator, count: int) -> np.ndarray:
    """world_from_cam [count, 4, 4] that look roughly at the origin from some 4 units away."""
    poses = np.tile(np.eye(4), (count, 1, 1))
    turned = Rotation.random(count, random_state=int(rng.integers(2**31))).as_matrix()
    poses[:, :3, :3] = turned
    poses[:, :3, 3] = -4.0 * turned[:, :, 2] + rng.normal(0, 0.1, (count, 3))
    return poses


def random_points(rng: np.random.Generator, keypoints: dict[int, int], count: int) -> ColmapPoints:
    """Points seen by random keypoints: of each image id there are so many, and each is of one point at most."""
    free = [(image, k) for image, number in keypoints.items() for k in range(number)]
    rng.shuffle(free)
    tracks = [free[3 * i : 3 * i + 3] for i in range(min(count, len(free) // 3))]
    elements = np.array([element for track in tracks for element in track], np.int64).reshape(-1, 2)
    ids = rng.permutation(10 * len(tracks))[: len(tracks)].astype(np.int64) + 1
    starts = np.concatenate(([0], np.cumsum([len(track) for track in tracks]))).astype(np.int64)
    return ColmapPoints(
        ids, rng.normal(size=(len(tracks), 3)), rng.integers(0, 256, (len(tracks), 3), dtype=np.uint8),
        rng.uniform(0, 2, len(tracks)), starts, elements[:, 0].copy(), elements[:, 1].copy(),
    )  # fmt: skip


def random_model(seed: int, *, rigs: bool, spaces: bool = False) -> ColmapModel:
    """Two cameras, three moments; ids with gaps and out of order; with ``rigs`` both cameras are bolted together."""
    rng = np.random.default_rng(seed)
    cameras = {7: random_camera(rng), 3: random_camera(rng)}
    sensor_from_rig = rigid_pose_of(rigid_inverse(random_poses(rng, 1))[0])
    images, frames = {}, {}
    moments = rigid_inverse(random_poses(rng, 3))
    for number, rig_from_world in enumerate(moments):
        taken = []
        for camera in cameras:
            second = np.eye(4) if camera == 7 else matrix_of_pose(sensor_from_rig)
            image = 100 - 10 * number - camera
            name = f"cam {camera}/ä{number}.jpg" if spaces else f"cam{camera}/ä{number}.jpg"
            pose = rigid_pose_of(second @ rig_from_world)
            xy = rng.uniform(0, HEIGHT, (int(rng.integers(3, 9)), 2))
            images[image] = ColmapImage(image, name, camera, pose, xy, np.full(len(xy), -1))
            taken.append((("CAMERA", camera), image))
        frames[20 - number] = ColmapFrame(20 - number, 5, rigid_pose_of(rig_from_world), tuple(taken))
    rig = ColmapRig(5, ("CAMERA", 7), {("CAMERA", 3): sensor_from_rig})
    model = ColmapModel(
        Path(),
        "binary",
        cameras,
        images,
        random_points(rng, {}, 0),
        {5: rig} if rigs else {},
        frames if rigs else {},
    )
    points = random_points(rng, {number: len(image.points2d_px) for number, image in images.items()}, 8)
    return with_points(model, points)


def random_result(
    seed: int, count: int = 5, model: str | None = None, *, several: bool = False
) -> RefinedSet:
    """A result of ``count`` images, by one camera or by two, some without a pose before; with points."""
    rng = np.random.default_rng([seed, 17])
    cameras = tuple(random_camera(rng, model) for _ in range(2 if several else 1))
    indices = [i % len(cameras) for i in range(count)]
    poses, before = random_poses(rng, count), random_poses(rng, count)
    names = [f"images/ö {i:02}.jpg" for i in range(count)]
    images = tuple(
        RefinedImage(f"./{name}", name, indices[i], poses[i], None if i == 1 else before[i], "given")
        for i, name in enumerate(names)
    )
    images = (replace(images[0], flags=("fixed",)), *images[1:])
    built = model_of_poses(names, cameras, indices, poses)
    seen = {
        number: ColmapImage(
            number,
            image.name,
            image.camera_id,
            image.cam_from_world,
            rng.uniform(0, HEIGHT, (6, 2)),
            np.full(6, -1),
        )
        for number, image in built.images.items()
    }
    built = ColmapModel(Path(), "binary", built.cameras, seen, built.points, {}, {})
    built = with_points(built, random_points(rng, dict.fromkeys(seen, 6), 8))
    similarity = Similarity(1.25, random_poses(rng, 1)[0, :3, :3], rng.normal(size=3))
    return RefinedSet(cameras, images, built, tuple(built.images), "features", similarity)
