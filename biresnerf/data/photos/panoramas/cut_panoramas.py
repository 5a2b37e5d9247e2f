"""Panoramas cut into the six faces of a cube: photos of one rig, which show every direction once.

So no feature counts twice, and a face's whole picture is new to the radiance field. After COLMAP's panorama_sfm.
"""

from __future__ import annotations

import posixpath
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from pathlib import Path, PurePosixPath

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from biresnerf.data.model.dataset import Cut, Dataset, Frame
from biresnerf.data.photos.bilinear import resampled
from biresnerf.data.photos.decode import decode
from biresnerf.data.photos.image_files import quiet_pillow
from biresnerf.data.photos.images import decoding_threads
from biresnerf.data.photos.masks import load_mask
from biresnerf.data.photos.panoramas.panorama import panorama_camera
from biresnerf.geometry.camera.camera_models import Camera

PANORAMA_VIEWS = "panorama_views"  # the folder of what is cut, in that of the result
# Rows: the view's x, y and z axis among the panorama's (x right, y down, z forward).
_FACES = {
    "front": ((1, 0, 0), (0, 1, 0), (0, 0, 1)),
    "right": ((0, 0, -1), (0, 1, 0), (1, 0, 0)),
    "back": ((-1, 0, 0), (0, 1, 0), (0, 0, -1)),
    "left": ((0, 0, 1), (0, 1, 0), (-1, 0, 0)),
    "up": ((1, 0, 0), (0, 0, 1), (0, -1, 0)),
    "down": ((1, 0, 0), (0, 0, -1), (0, 1, 0)),
}
_LEAST_SHOWN = 0.02  # of a view that its mask leaves
_QUALITY = 95


def called_panoramas(dataset: Dataset) -> Dataset:
    """The set with every photo that is twice as wide as high and has no given lens treated as a panorama."""
    cameras = tuple(
        panorama_camera(camera.width, camera.height, "")
        if camera.width == 2 * camera.height and dataset.source_of_intrinsics(index) != "given"
        else camera
        for index, camera in enumerate(dataset.cameras)
    )
    return replace(dataset, cameras=cameras)


def cut_panoramas(dataset: Dataset, folder: Path, on_photo: Callable[[int], object]) -> Dataset:
    """The set with views in the place of its panoramas, each with the pose that follows from theirs; else the set.

    Photos and masks of views are written below ``folder``/panorama_views, which is the new set's root. Views that a
    mask hides are left out. All views in one direction of panoramas of one size share a camera, as the sensors of rigs
    do. ``on_photo`` is called with the number of panoramas that are cut, after each; it may raise.

    Raises:
        InputError: a code of `decode` or `load_mask`.
    """
    whole = [i for i in range(len(dataset)) if dataset.camera_of(i).panorama]
    if not whole:
        return dataset
    with quiet_pillow(), ThreadPoolExecutor(decoding_threads(dataset), thread_name_prefix="cut") as pool:
        views: dict[int, list[tuple[str, Frame]]] = {}
        for row, found in zip(whole, pool.map(partial(_views, dataset, folder), whole), strict=True):
            views[row] = found
            on_photo(len(views))
    cameras: dict[tuple[int, str], int] = {}
    frames, rows, turns = [], [], []
    for row, frame in enumerate(dataset.frames):
        for face, view in views.get(row, [("", frame)]):
            camera = cameras.setdefault((frame.camera, face), len(cameras))
            turn = np.eye(4)
            turn[:3, :3] = _FACES.get(face, np.eye(3))
            pose = None if frame.world_from_cam is None else frame.world_from_cam @ turn.T
            frames.append(replace(view, camera=camera, world_from_cam=pose))
            rows.append(row)
            turns.append(turn)
    note = (
        f"{len(whole)} panoramas are cut into {sum(map(len, views.values()))} views ({PANORAMA_VIEWS}/), which keep "
        "their places to each other: transforms.json has one pose for each panorama"
    )
    return replace(
        dataset,
        root=folder,
        cameras=tuple(
            _face_camera(dataset.cameras[lens]) if face else dataset.cameras[lens] for lens, face in cameras
        ),
        intrinsics_sources=tuple(
            "given" if face else dataset.source_of_intrinsics(lens) for lens, face in cameras
        ),
        frames=tuple(frames),
        source=replace(dataset.source, colmap=None),
        warnings=(*dataset.warnings, note),
        cut=Cut(dataset, np.array(rows), np.stack(turns)),
    )


def as_views(dataset: Dataset) -> Dataset:
    """A set like that which `cut_panoramas` makes, for forecasts: its frames have no photos of their own."""
    cameras = tuple(_face_camera(camera) if camera.panorama else camera for camera in dataset.cameras)
    times = [len(_FACES) if dataset.camera_of(i).panorama else 1 for i in range(len(dataset))]
    frames = tuple(f for f, count in zip(dataset.frames, times, strict=True) for _ in range(count))
    return replace(dataset, cameras=cameras, frames=frames)


def place_in_view(
    dataset: Dataset, row: int, xy: tuple[float, float]
) -> tuple[int, tuple[float, float]] | None:
    """The frame that shows a place (px) of frame ``row`` of the set before it was cut, and where; None where none."""
    cut = dataset.cut
    if cut is None:
        return row, xy
    views, camera = np.flatnonzero(cut.rows == row), cut.whole.camera_of(row)
    if not camera.panorama:
        return int(views[0]), xy
    east, down = (2 * xy[0] / camera.width - 1) * np.pi, (xy[1] / camera.height - 0.5) * np.pi
    ray = np.array([np.cos(down) * np.sin(east), np.sin(down), np.cos(down) * np.cos(east)])
    in_views = cut.cam_from_whole[views, :3, :3] @ ray
    best = int(np.argmax(in_views[:, 2]))
    x, y, z = in_views[best].tolist()
    if z <= 0 or max(abs(x), abs(y)) > z * (1 + 1e-9):
        return None  # in a view that a mask hides
    half = camera.width // 4 / 2
    return int(views[best]), (half * (1 + x / z), half * (1 + y / z))


def _face_camera(panorama: Camera) -> Camera:
    """The camera of a face, with as many pixels around as the panorama has."""
    side = panorama.width // 4
    return Camera("PINHOLE", side, side, (side / 2, side / 2, side / 2, side / 2))


def _views(dataset: Dataset, folder: Path, row: int) -> list[tuple[str, Frame]]:
    """The views of a panorama that show something, by their faces, and their files written."""
    frame, camera = dataset.frames[row], dataset.camera_of(row)
    name = PurePosixPath(posixpath.normpath(dataset.file_names[row]).replace("../", ""))
    stem = f"{PANORAMA_VIEWS}/{name.with_suffix('').as_posix()}_{name.suffix[1:].lower()}"
    side, picture = camera.width // 4, _around(decode(frame, camera)[..., :3])
    counts = load_mask(frame, camera)
    places = {
        face: partial(_in_panorama, np.array(axes, np.float64), side, camera.width)
        for face, axes in _FACES.items()
    }
    masks: dict[str, NDArray[np.bool_]] = {}
    if counts is not None:
        masks = {face: _mask_of(counts, camera, at, side) for face, at in places.items()}
    some = {face for face, mask in masks.items() if mask.mean() >= _LEAST_SHOWN} or set(_FACES)
    found = []
    for face, at in places.items():
        if face not in some:
            continue
        mask = None
        if counts is not None:
            mask = folder / f"{stem}/{face}.mask.png"
            _save(Image.fromarray(masks[face].astype(np.uint8) * 255), mask)
        path = folder / f"{stem}/{face}.jpg"
        _save(Image.fromarray(resampled(picture, side, side, at)), path)
        view = replace(
            frame, name=f"{stem}/{face}.jpg", path=path, raw={}, mask=mask, mask_inverted=False, orientation=1,
            levels=None,
        )  # fmt: skip
        found.append((face, view))
    return found


def _save(picture: Image.Image, path: Path) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    picture.save(path, quality=_QUALITY, subsampling=0)


def _around(picture: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """The panorama with a column of the opposite side added at either side."""
    return np.concatenate([picture[:, -1:], picture, picture[:, :1]], axis=1)


def _in_panorama(
    axes: NDArray[np.float64], side: int, width: int, view_xy: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Where positions [m, 2] of a view lie in `_around` of its panorama, ``width`` px wide; all in px."""
    slopes = np.concatenate([view_xy / (side / 2) - 1, np.ones((len(view_xy), 1))], axis=1)
    x, y, z = (slopes @ axes).T
    east, down = np.arctan2(x, z), np.arctan2(y, np.hypot(x, z))
    return np.stack([(east / (2 * np.pi) + 0.5) * width + 1, (down / np.pi + 0.5) * (width / 2)], axis=1)


def _mask_of(
    counts: NDArray[np.bool_],
    camera: Camera,
    at: Callable[[NDArray[np.float64]], NDArray[np.float64]],
    side: int,
) -> NDArray[np.bool_]:
    """Which pixels [side, side] of a view count, by a mask of the panorama at any size."""
    y, x = np.mgrid[0:side, 0:side] + 0.5
    place = at(np.stack([x.ravel(), y.ravel()], axis=1)) - [1, 0]
    height, width = counts.shape
    column, line = (place * [width / camera.width, height / camera.height]).astype(np.int64).T
    found: NDArray[np.bool_] = counts[line.clip(0, height - 1), column.clip(0, width - 1)]
    return found.reshape(side, side)
