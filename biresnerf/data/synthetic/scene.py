"""A synthetic scene with exactly known poses, intrinsics and colours; made in seconds, without downloads."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from biresnerf.data.model.atomic_file import write_json
from biresnerf.data.model.conventions import file_from_world_from_cam
from biresnerf.data.synthetic.camera_photos import Maker, stored_poses, write_camera_photo
from biresnerf.data.synthetic.shapes import Shape, Texture
from biresnerf.geometry.rigid import motion_of

CAMERA_DISTANCE = 4.0  # like the NeRF-synthetic sets, as is the angle of view
CAMERA_ANGLE_X = 0.6911112
_ELEVATION_RAD = (0.09, 1.30)  # from just above the ground to nearly overhead
MADE_SCENE = "made_scene"  # key of the transforms file: which shapes were rendered (`studies/depth_error.py`)
_SUBSAMPLES = 3  # per pixel and axis; odd, so that one lies in the pixel's centre

# No rotation or mirror maps this onto itself, and no two sides look alike.
SHAPES = (
    Shape("box", (0.05, 0.0, -0.50), (1.00, 0.85, 0.08), (8.0, 0.0)),
    Shape("box", (-0.46, 0.32, -0.04), (0.25, 0.32, 0.38), (28.0, 0.0)),
    Shape("sphere", (0.46, 0.36, -0.04), (0.38, 0.38, 0.38), (0.0, 0.0)),
    Shape("cylinder", (0.42, -0.46, -0.09), (0.23, 0.23, 0.33), (15.0, 0.0)),
    Shape("box", (-0.40, -0.46, -0.23), (0.33, 0.17, 0.19), (-35.0, 0.0)),
    Shape("sphere", (-0.42, 0.31, 0.58), (0.25, 0.25, 0.25), (0.0, 0.0)),
    Shape("cylinder", (0.02, -0.04, 0.20), (0.13, 0.13, 0.62), (40.0, 32.0)),
)


class Coloured(Protocol):
    """What a shape looks like: lit colours float32 [n, 3], 0 to 1, of points and normals [n, 3] in the world."""

    def colour(self, points: NDArray[np.float32], normals: NDArray[np.float32], /) -> NDArray[np.float32]: ...


def synthetic_cameras(n_views: int, seed: int) -> NDArray[np.float64]:
    """world_from_cam [n_views, 4, 4] spread over a dome above the scene (z up), looking at the origin."""
    rng = np.random.default_rng([seed, 1])
    low, high = np.sin(_ELEVATION_RAD)
    heights = low + (high - low) * (np.arange(n_views) + rng.uniform(0.1, 0.9, n_views)) / n_views
    golden = np.pi * (3.0 - np.sqrt(5.0))
    azimuths = golden * np.arange(n_views) + rng.uniform(0, 2 * np.pi) + rng.normal(0, 0.1, n_views)
    across = np.sqrt(1.0 - heights**2)
    outward = np.stack([across * np.cos(azimuths), across * np.sin(azimuths), heights], axis=1)
    right = np.stack([-np.sin(azimuths), np.cos(azimuths), np.zeros(n_views)], axis=1)
    return motion_of(np.stack([right, np.cross(-outward, right), -outward], 2), CAMERA_DISTANCE * outward)


def synthetic_focal(size: int) -> float:
    """Focal length (px) of the square images of ``size`` px."""
    return 0.5 * size / float(np.tan(0.5 * CAMERA_ANGLE_X))


def render_synthetic(
    world_from_cam: NDArray[np.float64], size: int, seed: int
) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
    """One square view of the scene with the textures of ``seed``, from a pose [4, 4]: see `render_shapes`."""
    textures = random_textures(len(SHAPES), seed)
    return render_shapes(SHAPES, textures, world_from_cam, size, size, synthetic_focal(size))


def random_textures(count: int, seed: int) -> list[Texture]:
    """Textures that do not resemble each other; the same seed gives the same ones."""
    return [Texture.random(np.random.default_rng([seed, 2, index])) for index in range(count)]


def render_shapes(
    shapes: Sequence[Shape],
    textures: Sequence[Coloured],
    world_from_cam: NDArray[np.float64],
    width: int,
    height: int,
    focal: float,
) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
    """One view of shapes, each with its texture, by a pinhole of ``focal`` px centred in the image.

    Returns:
        straight-alpha colours uint8 [height, width, 4], each pixel the mean of 9 rays, and the depth along the
        optical axis in the pixel centres float32 [height, width], infinite where there is nothing.
    """
    rotation = world_from_cam[:3, :3]
    origin = world_from_cam[:3, 3].astype(np.float32)
    fine_x, fine_y = width * _SUBSAMPLES, height * _SUBSAMPLES
    x, y = np.meshgrid(
        ((np.arange(fine_x) + 0.5) / _SUBSAMPLES - width / 2) / focal,
        ((np.arange(fine_y) + 0.5) / _SUBSAMPLES - height / 2) / focal,
    )
    along_axis = np.stack([x, y, np.ones_like(x)], axis=-1).reshape(-1, 3)
    lengths = np.linalg.norm(along_axis, axis=1)
    directions = ((along_axis / lengths[:, None]) @ rotation.T).astype(np.float32)
    colour, distance = _trace(shapes, textures, origin, directions)

    hit = np.isfinite(distance)
    samples = np.concatenate([colour * hit[:, None], hit[:, None]], axis=1)
    mean = samples.reshape(height, _SUBSAMPLES, width, _SUBSAMPLES, 4).mean(axis=(1, 3))
    straight = mean[..., :3] / np.maximum(mean[..., 3:], 1e-6)
    rgba = np.concatenate([straight, mean[..., 3:]], axis=-1)
    middle = _SUBSAMPLES // 2
    depth = (distance / lengths).reshape(fine_y, fine_x)[middle::_SUBSAMPLES, middle::_SUBSAMPLES]
    return np.rint(255.0 * rgba).astype(np.uint8), depth.astype(np.float32)


def render_panorama(
    shapes: Sequence[Shape], textures: Sequence[Texture], world_from_cam: NDArray[np.float64], width: int
) -> NDArray[np.uint8]:
    """All directions from a pose [4, 4], equirectangular, forward in the middle: uint8 [width / 2, width, 3].

    Each pixel is the mean of 4 rays; black where there is nothing.
    """
    origin = world_from_cam[:3, 3].astype(np.float32)
    east = ((np.arange(2 * width) + 0.5) / width - 1) * np.pi
    rows = []
    for row in range(width // 2):
        down = ((2 * row + np.array([[0.5], [1.5]])) / width - 0.5) * np.pi
        level = np.cos(down)
        x, y, z = np.broadcast_arrays(level * np.sin(east), np.sin(down), level * np.cos(east))
        directions = np.stack([x, y, z], axis=-1).reshape(-1, 3) @ world_from_cam[:3, :3].T
        colour = _trace(shapes, textures, origin, directions.astype(np.float32))[0]
        rows.append(colour.reshape(2, width, 2, 3).mean(axis=(0, 2)))
    return np.rint(255.0 * np.stack(rows)).clip(0, 255).astype(np.uint8)


def _trace(
    shapes: Sequence[Shape],
    textures: Sequence[Coloured],
    origin: NDArray[np.float32],
    directions: NDArray[np.float32],
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Colours [rays, 3] and distances [rays] (infinite for a miss) of the nearest surfaces."""
    nearest = np.full(len(directions), np.inf, dtype=np.float32)
    which = np.full(len(directions), -1)
    normals = np.zeros_like(directions)
    for index, shape in enumerate(shapes):
        rays = _rays_that_may_hit(shape, origin, directions)
        hit = shape.intersect(origin, directions[rays])
        closer = hit.distance < np.minimum(nearest[rays], 1e6)
        chosen = rays[closer]
        nearest[chosen], normals[chosen], which[chosen] = hit.distance[closer], hit.normal[closer], index
    colour = np.zeros_like(directions)
    for index, texture in enumerate(textures):
        rays = np.flatnonzero(which == index)
        points = origin + nearest[rays, None] * directions[rays]
        colour[rays] = texture.colour(points, normals[rays])
    return colour, nearest


def _rays_that_may_hit(
    shape: Shape, origin: NDArray[np.float32], directions: NDArray[np.float32]
) -> NDArray[np.intp]:
    """Indices of rays in the cone about the shape's bounding sphere; of all rays from within it."""
    to_centre = np.asarray(shape.centre, np.float32) - origin
    distance = float(np.linalg.norm(to_centre))
    if distance <= shape.bounding_radius:
        return np.arange(len(directions))
    cosine = np.sqrt(1.0 - (shape.bounding_radius / distance) ** 2)
    return np.flatnonzero(directions @ to_centre >= cosine * distance - 1e-4)


def write_synthetic_scene(
    folder: Path, n_views: int, size: int, seed: int, maker: Maker | None = None
) -> Path:
    """Writes ``n_views`` square images of ``size`` px and transforms.json (Blender dialect, true poses).

    Returns:
        the path of transforms.json, written last.
    """
    poses = synthetic_cameras(n_views, seed)
    pictures = (render_synthetic(pose, size, seed)[0] for pose in poses)
    return write_blender_set(folder, poses, pictures, "dome", maker)


def write_blender_set(
    folder: Path,
    poses: NDArray[np.float64],
    pictures: Iterable[NDArray[np.uint8]],
    made: str,
    maker: Maker | None = None,
) -> Path:
    """Writes the picture of each pose [n, 4, 4] to train/, then transforms.json (Blender dialect); returns its path.

    Args:
        made: the shapes' name, for `true_distance`.
        maker: whose cameras take the pictures before a white wall; None: cut out, as PNG. Poses are written for pixels
            as stored.
    """
    (folder / "train").mkdir(parents=True, exist_ok=True)
    for index, picture in enumerate(pictures):
        path = folder / "train" / f"r_{index}.png"
        if maker is None:
            Image.fromarray(picture).save(path, compress_level=3)
        else:
            focal = synthetic_focal(len(picture))
            write_camera_photo(path.with_suffix(".jpg"), picture, maker, index, focal, poses[index])
    frames = [
        {"file_path": f"./train/r_{index}", "transform_matrix": matrix.tolist()}
        for index, matrix in enumerate(file_from_world_from_cam(stored_poses(poses, maker), np.eye(4), 1.0))
    ]
    path = folder / "transforms.json"
    write_json(path, {"camera_angle_x": CAMERA_ANGLE_X, MADE_SCENE: made, "frames": frames}, indent=1)
    return path
