"""Small scenes on disk for the tests of reading and writing: real image files, made up poses."""

from __future__ import annotations

import json
import tracemalloc
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from biresnerf.data.seeding import map_images
from biresnerf.data.synthetic.camera_photos import Maker, stored_poses, write_camera_photo
from biresnerf.data.synthetic.scene import render_synthetic, synthetic_cameras, synthetic_focal
from biresnerf.errors import InputError

WIDTH, HEIGHT = 20, 16


def write_image(
    path: Path, seed: int = 0, size: tuple[int, int] = (WIDTH, HEIGHT), mode: str = "RGB"
) -> None:
    """A noise image of the given mode, in the format its extension says."""
    path.parent.mkdir(parents=True, exist_ok=True)
    channels = {"L": (), "RGB": (3,), "RGBA": (4,)}[mode]
    values = np.random.default_rng(seed).integers(0, 256, (size[1], size[0], *channels), dtype=np.uint8)
    Image.fromarray(values).save(path)


def opengl_poses(count: int, seed: int = 0) -> list[list[list[float]]]:
    """Camera-to-world matrices as a file holds them: nothing special about them but being rigid."""
    rng = np.random.default_rng(seed)
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, :3, :3] = Rotation.random(count, random_state=seed).as_matrix()
    poses[:, :3, 3] = rng.normal(size=(count, 3)) * 3
    return poses.tolist()


def nerfstudio_scene(folder: Path, count: int = 4, **top: Any) -> dict[str, Any]:
    """Writes images/*.jpg and returns the document of a transforms.json for them, with shared intrinsics."""
    for index in range(count):
        write_image(folder / f"images/{index:03}.jpg", index)
    frames = [
        {"file_path": f"images/{index:03}.jpg", "transform_matrix": pose}
        for index, pose in enumerate(opengl_poses(count))
    ]
    intrinsics = {"w": WIDTH, "h": HEIGHT, "fl_x": 18.0, "fl_y": 18.5, "cx": 10.25, "cy": 7.75}
    return {"camera_model": "OPENCV", **intrinsics, **top, "frames": frames}


def blender_scene(folder: Path, count: int = 4) -> dict[str, Any]:
    """Writes train/r_*.png (RGBA) and returns the document of a Blender transforms file."""
    for index in range(count):
        write_image(folder / f"train/r_{index}.png", index, mode="RGBA")
    frames = [
        {"file_path": f"./train/r_{index}", "rotation": 0.0125, "transform_matrix": pose}
        for index, pose in enumerate(opengl_poses(count))
    ]
    return {"camera_angle_x": 0.6911112070083618, "frames": frames}


def save(folder: Path, document: Any, name: str = "transforms.json") -> Path:
    """Writes the document, NaN and all, and returns its path."""
    path = folder / name
    path.write_text(document if isinstance(document, str) else json.dumps(document), "utf-8")
    return path


def assert_complete(error: InputError, code: str, *where: str) -> None:
    """The error has the code, names every part of ``where``, and says what and how to fix it."""
    assert error.code == code, f"{error.code}: {error}"
    for part in where:
        assert part in error.where, f"{part!r} is not in {error.where!r}"
    assert error.detail.endswith("."), error.detail
    assert error.hint.endswith("."), error.hint


def refused_at_once(read: Callable[[], object]) -> InputError:
    """The error that ``read`` raises: within 200 MB, and saying what and how to fix it."""
    tracemalloc.start()
    with pytest.raises(InputError) as caught:
        read()
    assert tracemalloc.get_traced_memory()[1] < 200 * 2**20
    tracemalloc.stop()
    assert caught.value.detail.endswith(".")
    assert caught.value.hint.endswith(".")
    return caught.value


@contextmanager
def plain_features() -> Iterator[None]:
    """Plain features do for these scenes, at a seventh of the time."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(map_images, "THOROUGH_UP_TO", 0)
        yield


def arc_poses(views: int) -> np.ndarray:
    """Cameras 8 degrees apart around the synthetic scene, so that neighbours see the same texture."""
    start = synthetic_cameras(11, 4)[5]
    poses = np.tile(np.eye(4), (views, 1, 1))
    for index, turn in enumerate(np.radians(8.0 * np.arange(views))):
        about_z = np.array([[np.cos(turn), -np.sin(turn), 0], [np.sin(turn), np.cos(turn), 0], [0, 0, 1]])
        poses[index, :3] = about_z @ start[:3]
    return poses


def textured_arc(folder: Path, views: int, size: int, maker: Maker | None = None) -> np.ndarray:
    """Photos 00.png ... of the arc in `folder`, over grey so that no border is too sharp; returns its poses.

    A maker's camera writes 00.jpg ..., and the poses are those of the pixels as it stores them.
    """
    folder.mkdir(parents=True, exist_ok=True)
    poses = arc_poses(views)
    for index, pose in enumerate(poses):
        picture = Image.fromarray(render_synthetic(pose, size, 4)[0])
        grey = Image.new("RGBA", picture.size, (128, 128, 128, 255))
        photo = Image.alpha_composite(grey, picture).convert("RGB")
        path = folder / f"{index:02}.png"
        if maker is None:
            photo.save(path)
        else:
            shown = np.asarray(photo)
            write_camera_photo(path.with_suffix(".jpg"), shown, maker, index, synthetic_focal(size), pose)
    return stored_poses(poses, maker)
