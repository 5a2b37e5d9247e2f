"""What an output folder shows at one moment: the preview of a run in progress, else the result."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from biresnerf.arrays import Array
from biresnerf.data.formats.read_dataset import read_dataset
from biresnerf.data.formats.simple.poses_json import POSES, matrix_of, read_poses_json
from biresnerf.data.photos.images import load_images
from biresnerf.data.show.view_file import PREVIEW, VIEW, ContactSheet, read_view_file
from biresnerf.data.show.view_pictures import read_points
from biresnerf.errors import InputError
from biresnerf.geometry.camera.camera_models import Camera
from biresnerf.viewer.report_html import read_report

Picture = NDArray[np.uint8]
PHOTO_PX = 192  # long side of a photo in its frustum
_NO_POSE = np.full((4, 4), np.nan)


@dataclass(frozen=True, eq=False)
class Seen:
    """Cameras and points.

    Attributes:
        names: of the images.
        after, before: world_from_cam [n, 4, 4]: the best so far, or refined, and as given; NaN where there is none.
        cameras: each image's, at full size.
        points, colours: [m, 3] in the input's world, and uint8 [m, 3].
        said: how far the run is, or how it ended.
    """

    names: tuple[str, ...]
    after: Array
    before: Array
    cameras: tuple[Camera, ...]
    points: Array
    colours: Picture
    said: str


def newest_poses(folder: Path) -> Path | None:
    """The file with the poses to show: of the run in progress, else of the result; None while there is neither."""
    running, done = folder / PREVIEW / POSES, folder / VIEW
    if running.is_file():
        return running
    return folder / read_view_file(folder).poses if done.is_file() else None


def read_state(folder: Path, poses: Path) -> Seen:
    """The cameras of ``poses`` with what ``folder`` has beside them.

    Raises:
        InputError: a file cannot be read, or is not as it was written.
    """
    document = read_poses_json(poses)
    points, colours = np.empty((0, 3)), np.empty((0, 3), np.uint8)
    if poses.parent.name != PREVIEW:
        layers = read_view_file(folder).points
        if layers:
            points, colours = read_points(folder, max(layers, key=lambda layer: layer.count))
    before = [i.world_from_cam_before for i in document.images]
    return Seen(
        names=tuple(image.name for image in document.images),
        after=np.array([matrix_of(image.world_from_cam) for image in document.images]),
        before=np.array([_NO_POSE if rows is None else matrix_of(rows) for rows in before]),
        cameras=tuple(document.cameras[image.camera] for image in document.images),
        points=points,
        colours=colours,
        said=_said(poses.parent if poses.parent.name == PREVIEW else folder),
    )


def _said(folder: Path) -> str:
    try:
        report = read_report(folder)
    except InputError:
        return "looking for poses to start from"
    if report.verdict is not None:
        return report.verdict.in_words()[0]
    return f"step {report.steps_done} of {report.options.steps}"


def photos_of(source: Path) -> dict[str, Picture]:
    """The photos of an image set by name, small. Raises InputError as `read_dataset` and `load_images` do."""
    dataset = read_dataset(source)
    images = load_images(dataset, PHOTO_PX, "none")
    return {name: images.image(i) for i, name in enumerate(dataset.names)}


def photos_of_result(folder: Path, seen: Seen) -> dict[str, Picture]:
    """The photos on the contact sheet of a result by name; none during a run, or for very many photos."""
    sheet = read_view_file(folder).contact_sheet if (folder / VIEW).is_file() else None
    if sheet is None or not (folder / sheet.file).is_file():
        return {}
    with Image.open(folder / sheet.file) as picture:
        pixels = np.asarray(picture.convert("RGB"))
    return {name: _cell(pixels, sheet, i, seen.cameras[i]) for i, name in enumerate(seen.names)}


def _cell(pixels: Picture, sheet: ContactSheet, index: int, camera: Camera) -> Picture:
    """The photo in the middle of its cell, without what is around it."""
    row, column = divmod(index, sheet.columns)
    scale = min(sheet.cell_width / camera.width, sheet.cell_height / camera.height)
    width = min(sheet.cell_width, max(1, round(scale * camera.width)))
    height = min(sheet.cell_height, max(1, round(scale * camera.height)))
    left = column * sheet.cell_width + (sheet.cell_width - width) // 2
    top = row * sheet.cell_height + (sheet.cell_height - height) // 2
    return pixels[top : top + height, left : left + width]
