"""Image sets as people bring them, of synthetic scenes: a phone's walk, half of a COLMAP model, a plain vase."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from biresnerf.data.model.atomic_file import write_json
from biresnerf.data.model.conventions import file_from_world_from_cam
from biresnerf.data.photos.orientation import turned_size
from biresnerf.data.synthetic.camera_photos import Maker, stored_poses, turn_of, write_camera_photo
from biresnerf.data.synthetic.scene import (
    CAMERA_DISTANCE,
    MADE_SCENE,
    SHAPES,
    random_textures,
    render_panorama,
    render_shapes,
    synthetic_cameras,
    synthetic_focal,
    write_blender_set,
)
from biresnerf.data.synthetic.shapes import Shape, Texture
from biresnerf.geometry.camera.camera_models import PANORAMA
from biresnerf.geometry.level_ring import level_ring
from biresnerf.geometry.rigid import motion_of, rotation_of

# The objects of the scene stand on a table in a room, which fills the photos.
TABLE_SCENE = (
    *SHAPES,
    Shape("box", (0.1, -0.05, -0.64), (1.9, 1.5, 0.06), (12.0, 0.0)),
    Shape("room", (0.0, 0.0, 0.0), (8.0, 8.0, 8.0), (0.0, 0.0)),
)
# Walls far away show patches, not grain.
_TABLE_SCALES, _ROOM_SCALES = 4, 2
# Its sides differ only by the spout and a glaze that hardly changes.
VASE = (
    Shape("cylinder", (0.0, 0.0, -0.85), (0.36, 0.36, 0.08), (0.0, 0.0)),
    Shape("sphere", (0.0, 0.0, -0.25), (0.62, 0.62, 0.62), (0.0, 0.0)),
    Shape("cylinder", (0.0, 0.0, 0.45), (0.24, 0.24, 0.30), (0.0, 0.0)),
    Shape("cylinder", (0.0, 0.0, 0.78), (0.34, 0.34, 0.05), (0.0, 0.0)),
    Shape("cylinder", (0.48, 0.0, 0.40), (0.07, 0.07, 0.36), (90.0, 35.0)),
)
_GLAZE = ((0.34, 0.50, 0.52), (0.36, 0.52, 0.54), (0.36, 0.50, 0.53), (0.33, 0.48, 0.50), (0.38, 0.50, 0.50))
_GLAZE_CONTRAST = 0.05
# A phone's main camera held across, 4:3; its world has y up and metres, where the scene has z up.
PHONE_FOCAL_OF_WIDTH = 0.77
PHONE_FROM_SCENE = np.array([[1.0, 0, 0, 0], [0, 0, 1.0, 0], [0, -1.0, 0, 0], [0, 0, 0, 1.0]])
TABLE_METRES = 0.35
_TABLE_ELEVATION_RAD = 0.42
_TILT_RAD = 0.05
_GPANO = (
    b'<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">'
    b'<rdf:Description rdf:about="" xmlns:GPano="http://ns.google.com/photos/1.0/panorama/" '
    b'GPano:ProjectionType="equirectangular"/></rdf:RDF></x:xmpmeta>'
)
_WALK_TURNS, _WALK_DISTANCE, _WALK_ELEVATION_RAD = 1.2, 3.3, (0.42, 0.75)


def walking_cameras(n_views: int, seed: int) -> NDArray[np.float64]:
    """world_from_cam [n_views, 4, 4] on a walk around the table (z up), 1.2 rounds at changing heights."""
    rng = np.random.default_rng([seed, 4])
    along = np.arange(n_views) / max(n_views - 1, 1)
    azimuth = rng.uniform(0, 2 * np.pi) + 2 * np.pi * _WALK_TURNS * along
    low, high = _WALK_ELEVATION_RAD
    elevation = low + (high - low) * (0.5 - 0.5 * np.cos(2 * np.pi * 2.3 * along))
    distance = _WALK_DISTANCE * (1 + 0.08 * np.sin(2 * np.pi * 3.1 * along))
    across = np.cos(elevation)
    outward = np.stack([across * np.cos(azimuth), across * np.sin(azimuth), np.sin(elevation)], axis=1)
    centres = distance[:, None] * outward
    targets = rng.normal(0, 0.08, (n_views, 3))
    forward = targets - centres
    forward /= np.linalg.norm(forward, axis=1, keepdims=True)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    return motion_of(np.stack([right, np.cross(forward, right), forward], 2), centres)


def table_textures(seed: int) -> list[Texture]:
    """The textures of `TABLE_SCENE`."""
    around = [
        Texture.random(np.random.default_rng([seed, 7, scales]), scales)
        for scales in (_TABLE_SCALES, _ROOM_SCALES)
    ]
    return random_textures(len(SHAPES), seed) + around


def write_walk(folder: Path, n_views: int, width: int, seed: int, maker: Maker | None = None) -> Path:
    """Writes photos of a walk around the table and transforms.json as NeRFCapture does, with true poses, in metres.

    Args:
        width: of the pixels as stored, px; the photos are 4 to 3.
        maker: whose camera is carried, on its side for photos that its EXIF turns; None: PNG, level. Poses and lens are
            those of the stored pixels.

    Returns:
        the path of transforms.json.
    """
    height, focal = round(width * 3 / 4), PHONE_FOCAL_OF_WIDTH * width
    poses = walking_cameras(n_views, seed)
    textures = table_textures(seed)
    (folder / "images").mkdir(parents=True, exist_ok=True)
    for index, pose in enumerate(poses):
        size = turned_size(width, height, turn_of(maker, index))
        pixels = render_shapes(TABLE_SCENE, textures, pose, *size, focal)[0][..., :3].copy()
        path = folder / "images" / f"{index}.png"
        if maker is None:
            Image.fromarray(pixels).save(path, compress_level=3)
        else:
            write_camera_photo(path.with_suffix(".jpg"), pixels, maker, index, focal, pose)
    in_metres = PHONE_FROM_SCENE @ stored_poses(poses, maker)
    in_metres[:, :3, 3] *= TABLE_METRES
    lens = {
        "fl_x": focal,
        "fl_y": focal,
        "cx": width / 2,
        "cy": height / 2,
        "w": width,
        "h": height,
    }
    frames = [
        {"file_path": f"images/{index}", "transform_matrix": matrix.tolist(), "timestamp": index / 2, **lens}
        for index, matrix in enumerate(file_from_world_from_cam(in_metres, np.eye(4), 1.0))
    ]
    path = folder / "transforms.json"
    write_json(path, {**lens, MADE_SCENE: "table", "frames": frames}, indent=1)
    return path


def write_panoramas(folder: Path, n_views: int, width: int, seed: int) -> Path:
    """Writes panoramas (JPEG, named so by their XMP) of a walk around the table, and nerfstudio's transforms.json.

    The camera is held upright to a few degrees and turned arbitrarily; poses are the true ones.

    Returns:
        the path of transforms.json.
    """
    rng = np.random.default_rng([seed, 11])
    poses = walking_cameras(n_views, seed)
    upright = np.array([[1.0, 0, 0], [0, 0, 1.0], [0, -1.0, 0]])  # looking along y
    turns = np.stack([np.zeros(n_views), np.zeros(n_views), rng.uniform(0, 2 * np.pi, n_views)], axis=1)
    tilts = rng.normal(0, _TILT_RAD, (n_views, 3))
    poses[:, :3, :3] = rotation_of(turns) @ upright @ rotation_of(tilts)
    textures = table_textures(seed)
    (folder / "images").mkdir(parents=True, exist_ok=True)
    for index, pose in enumerate(poses):
        picture = render_panorama(TABLE_SCENE, textures, pose, width)
        Image.fromarray(picture).save(folder / "images" / f"{index:03}.jpg", quality=95, xmp=_GPANO)
    frames = [
        {"file_path": f"images/{index:03}.jpg", "transform_matrix": matrix.tolist()}
        for index, matrix in enumerate(file_from_world_from_cam(poses, np.eye(4), 1.0))
    ]
    path = folder / "transforms.json"
    size = {"camera_model": PANORAMA, "w": width, "h": width // 2}
    write_json(path, {**size, MADE_SCENE: "table", "frames": frames}, indent=1)
    return path


def write_vase(folder: Path, n_views: int, size: int, seed: int, maker: Maker | None = None) -> Path:
    """Writes square cut-out views of the vase and transforms.json (Blender dialect, true poses); returns its path."""
    return _write_vase(folder, synthetic_cameras(n_views, seed), size, seed, maker)


def turntable_cameras(n_views: int, uneven: float, seed: int) -> NDArray[np.float64]:
    """world_from_cam [n_views, 4, 4] before a table (z up) that turns once.

    Args:
        uneven: steps are longer or shorter than their mean by up to this share.
    """
    rng = np.random.default_rng([seed, 9])
    steps = 1 + uneven * rng.uniform(-1, 1, n_views)
    poses = level_ring(2 * np.pi * np.cumsum(steps) / steps.sum(), _TABLE_ELEVATION_RAD)
    poses[:, :3, 3] *= CAMERA_DISTANCE
    return poses


def write_turntable(
    folder: Path, n_views: int, size: int, seed: int, uneven: float, maker: Maker | None = None
) -> Path:
    """Writes square cut-out views of the vase on a turntable and transforms.json as `write_vase` does."""
    return _write_vase(folder, turntable_cameras(n_views, uneven, seed), size, seed, maker)


def _write_vase(folder: Path, poses: NDArray[np.float64], size: int, seed: int, maker: Maker | None) -> Path:
    textures = [
        Texture.glaze(np.random.default_rng([seed, 5, index]), base, _GLAZE_CONTRAST)
        for index, base in enumerate(_GLAZE)
    ]
    focal = synthetic_focal(size)
    pictures = (render_shapes(VASE, textures, pose, size, size, focal)[0] for pose in poses)
    return write_blender_set(folder, poses, pictures, "vase", maker)
