"""Small pictures and points of a set, for pages that show it: a thumbnail, all photos in one, points as bytes."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from biresnerf.data.model.atomic_file import whole_file
from biresnerf.data.photos.images import ImageSet
from biresnerf.data.show.view_file import CONTACT_SHEET, POINTS, ContactSheet, ShownPoints
from biresnerf.errors import InputError

THUMBNAIL_PX = 320
# Long side of a photo in the contact sheet by how many there are at most: some megabytes, and no side that JPEG or a
# browser cannot take.
CELL_PX = ((400, 96), (1200, 64), (4000, 40))
QUALITY = 80  # of JPEG
MOST_POINTS = 20_000  # 300 kB
_AROUND = (128, 128, 128)  # between photos of different shapes


def write_thumbnail(photo: NDArray[np.uint8], path: Path) -> Path:
    """Writes a photo [h, w, 3], at most 320 px long."""
    picture = Image.fromarray(photo)
    picture.thumbnail((THUMBNAIL_PX, THUMBNAIL_PX), Image.Resampling.LANCZOS)
    return _write_jpeg(picture, path)


def write_contact_sheet(images: ImageSet, folder: Path) -> ContactSheet | None:
    """All photos in one picture, and where each lies; None, and no file, for more than 4,000."""
    sides = [side for count, side in CELL_PX if len(images) <= count]
    if not sides:
        return None
    scales = [min(1.0, sides[0] / max(w, h)) for w, h in zip(images.widths, images.heights, strict=True)]
    cell_width = max(max(1, round(w * s)) for w, s in zip(images.widths, scales, strict=True))
    cell_height = max(max(1, round(h * s)) for h, s in zip(images.heights, scales, strict=True))
    columns = math.ceil(math.sqrt(len(images) * cell_height / cell_width))
    rows = math.ceil(len(images) / columns)
    sheet = Image.new("RGB", (columns * cell_width, rows * cell_height), _AROUND)
    for i in range(len(images)):
        photo = Image.fromarray(images.image(i))
        photo.thumbnail((cell_width, cell_height), Image.Resampling.BOX)
        left = (i % columns) * cell_width + (cell_width - photo.width) // 2
        top = (i // columns) * cell_height + (cell_height - photo.height) // 2
        sheet.paste(photo, (left, top))
    _write_jpeg(sheet, folder / CONTACT_SHEET)
    return ContactSheet(file=CONTACT_SHEET, columns=columns, cell_width=cell_width, cell_height=cell_height)


def write_points(
    layers: Sequence[tuple[str, NDArray[np.floating], NDArray[np.uint8]]], folder: Path
) -> tuple[ShownPoints, ...]:
    """Writes a file for each layer: its source, positions [n, 3] in the input's world and colours [n, 3].

    More than 20,000 points are thinned evenly; a layer without points has no file.
    """
    written = []
    for source, positions, colours in layers:
        step = max(1, -(-len(positions) // MOST_POINTS))
        shown = np.isfinite(positions).all(1)[::step]
        xyz, rgb = positions[::step][shown].astype(np.float64), colours[::step][shown]
        if not len(xyz):
            continue
        origin = np.median(xyz, axis=0)
        name = POINTS.format(source=source)
        with whole_file(folder / name) as temporary:
            temporary.write_bytes((xyz - origin).astype("<f4").tobytes() + rgb.astype(np.uint8).tobytes())
        x, y, z = origin.tolist()
        written.append(
            ShownPoints.model_validate(
                {"source": source, "file": name, "count": len(xyz), "origin": (x, y, z)}
            )
        )
    return tuple(written)


def read_points(folder: Path, shown: ShownPoints) -> tuple[NDArray[np.float64], NDArray[np.uint8]]:
    """Positions [n, 3] in the input's world and colours [n, 3] of a layer of the result in ``folder``.

    Raises:
        InputError: ``view_file_invalid`` for a file of another length; OSError where it is not there.
    """
    content = (folder / shown.file).read_bytes()
    if len(content) != 15 * shown.count:
        raise InputError(
            "view_file_invalid",
            f"has {len(content)} bytes, not {15 * shown.count}.",
            where=shown.file,
            hint="Leave the files of a result together, as they were written.",
        )
    xyz = np.frombuffer(content, "<f4", 3 * shown.count).reshape(-1, 3)
    rgb = np.frombuffer(content, np.uint8, offset=12 * shown.count).reshape(-1, 3)
    return xyz.astype(np.float64) + shown.origin, rgb


def _write_jpeg(picture: Image.Image, path: Path) -> Path:
    with whole_file(path) as temporary:
        picture.convert("RGB").save(temporary, format="JPEG", quality=QUALITY, optimize=True)
    return path
