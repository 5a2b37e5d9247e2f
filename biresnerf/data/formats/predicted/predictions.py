"""Poses and lenses that a network predicted: of VGGT, Depth Anything 3, DUSt3R and MASt3R.

The first two write them themselves (VGGT's demo_gradio.py predictions.npz, Depth Anything 3 exports/npz/results.npz):
world to camera. For the others, people save what ``get_im_poses()``, ``get_focals()`` and the like give: camera to
world. None names photos, and all lenses are those of the scaled pictures; a principal point lies in their middle.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from biresnerf.data.formats.bind_images import in_order
from biresnerf.data.formats.codec import Codec
from biresnerf.data.formats.parsed_poses import FrameCamera, ParsedPoses
from biresnerf.data.formats.pose_rows import ORDER_HINT, Placed, lens_of, parsed_rows, pose_by
from biresnerf.data.formats.predicted.seen_pictures import (
    VGGT,
    Margin,
    Seen,
    Size,
    seen_by_depth_anything,
    seen_by_dust3r,
    seen_by_vggt,
)
from biresnerf.data.model.array_file import (
    HEAD_BYTES,
    npy_numbers,
    npy_shape,
    npz_numbers,
    npz_rows,
    npz_shapes,
)
from biresnerf.data.model.untrusted_file import invalid_file, read_bytes
from biresnerf.data.photos.guessed_lens import refuse_other_units
from biresnerf.data.photos.image_files import ImageHeader
from biresnerf.errors import InputError
from biresnerf.options.formats import Format

FEED_FORWARD = Format(
    name="feed-forward",
    title="VGGT, Depth Anything 3",
    rank=96,
    found_as=("predictions.npz", "results.npz", "exports/npz/results.npz", "exports/mini_npz/results.npz"),
    suffixes=(".npz",),
    gives="poses; lenses as first guesses",
    checked_against="their sources",
    cam_from_world=True,
)
DUST3R = Format(
    name="dust3r",
    title="DUSt3R, MASt3R",
    rank=97,
    found_as=("poses.npz", "poses.npy", "camera_poses.npy", "cams2world.npy"),
    suffixes=(".npz", ".npy"),
    gives="the same, lenses beside them",
    checked_against="their sources",
)

_CAM_FROM_WORLD = ("extrinsic", "extrinsics")
_WORLD_FROM_CAM = ("poses", "camera_poses", "cams2world", "cam2world", "cam2w", "c2w", "im_poses")
_LENSES = ("intrinsic", "intrinsics", "K", "focals", "camera_focals", "focal")
_CENTRES = ("pps", "camera_pps", "principal_points")
# Either at the size that the lens is for.
_DEPTHS, _PICTURES = ("depth", "depths"), ("images", "image", "imgs")
_MOST_BYTES = 16 * 2**20
_MOST_SMALL = 240  # px; the pictures of the smaller of DUSt3R's networks
_HINT = "Give the file as the program wrote it, with poses [n, 4, 4] and a lens or a focal length for each."
Array = NDArray[np.float64]


class _Arrays:
    """What a program saved: the arrays of an npz file, or npy files beside each other."""

    def __init__(self, file: Path) -> None:
        self.file = file
        self.shapes: dict[str, tuple[int, ...]] = {}
        if file.suffix.lower() == ".npz":
            self.shapes = npz_shapes(file, _HINT)
        else:
            for name in (file.stem, *_LENSES, *_CENTRES):
                path = file.with_name(f"{name}.npy")
                if path.is_file():
                    with path.open("rb") as opened:
                        self.shapes[name] = npy_shape(opened.read(HEAD_BYTES))
        self.count = next((shape[0] for name, shape in self.shapes.items() if self._is_pose(name, shape)), 0)

    @staticmethod
    def _is_pose(name: str, shape: tuple[int, ...]) -> bool:
        known = name in _CAM_FROM_WORLD + _WORLD_FROM_CAM
        return known and len(shape) == 3 and shape[1:] in ((3, 4), (4, 4))

    def name_of(self, names: tuple[str, ...]) -> str | None:
        """The first of these arrays that is there with a row for each pose."""
        return next((name for name in names if self.shapes.get(name, ())[:1] == (self.count,)), None)

    def numbers(self, name: str) -> Array:
        if self.file.suffix.lower() == ".npz":
            return npz_numbers(self.file, name.__eq__, _MOST_BYTES, _HINT)[name]
        path = self.file.with_name(f"{name}.npy")
        return npy_numbers(read_bytes(path, _MOST_BYTES), path.name, _HINT)

    @property
    def files(self) -> tuple[Path, ...]:
        if self.file.suffix.lower() == ".npz":
            return (self.file,)
        return tuple(self.file.with_name(f"{name}.npy") for name in self.shapes)

    def picture_size(self, centre: Array | None) -> Size | None:
        """Width and height of the pictures that the lenses are for: from depths or pictures, else twice the centre."""
        name = self.name_of(_DEPTHS + _PICTURES)
        if name is not None:
            return _size(self.shapes[name])
        return None if centre is None else (round(2 * centre[:, 0].max()), round(2 * centre[:, 1].max()))

    def margins(self, picture: Size) -> list[Margin]:
        """The empty margins of the pictures, in pixels of ``picture``."""
        name = self.name_of(_PICTURES)
        shape = self.shapes.get(name or "", ())
        if (
            name is None
            or self.file.suffix.lower() != ".npz"
            or len(shape) != 4
            or 3 not in (shape[1], shape[3])
        ):
            return [Margin()] * self.count
        per_pixel = picture[0] / max(1, _size(shape)[0])
        rows = [_margin(row, per_pixel) for row in npz_rows(self.file, name, _HINT)]
        return rows or [Margin()] * self.count


def _size(shape: tuple[int, ...]) -> Size:
    """Width and height of pictures [n, 3, h, w], [n, h, w, 3], [n, h, w, 1] or [n, h, w]."""
    height, width = ([length for length in shape[1:] if length > 4] + [0, 0])[:2]
    return width, height


def _margin(picture: Array, per_pixel: float) -> Margin:
    pixels = np.moveaxis(picture, 0, 2) if picture.shape[0] == 3 else picture
    for value in (1.0, 0.0):
        empty = (pixels == value).all(axis=2)
        columns, rows = (int(np.cumprod(empty.all(axis=axis)).sum()) for axis in (0, 1))
        if columns or rows:
            return Margin(columns * per_pixel, rows * per_pixel, value == 0.0)
    return Margin()


def _parse(form: Format, names: tuple[str, ...], file: Path) -> ParsedPoses:
    arrays = _Arrays(file)
    poses_name, lenses_name = arrays.name_of(names), arrays.name_of(_LENSES)
    if poses_name is None or lenses_name is None:
        raise invalid_file(file.name, "has no poses with a lens, or a focal length, for each.", _HINT)
    poses, focal, centre = arrays.numbers(poses_name), *_lenses(arrays, lenses_name)
    lens_at = _lens_at(arrays, focal, centre, poses_name)

    def read(number: int, where: str) -> Placed:
        return pose_by(form, poses[number], where), partial(lens_at, number, where)

    rows = [(str(i), f"{file.name} {poses_name}[{i}]", i) for i in range(arrays.count)]
    parsed = parsed_rows(form, arrays.files, rows, read)
    entries = tuple(replace(entry, upright=not form.cam_from_world) for entry in parsed.entries)
    assign = partial(in_order, entries, file=file.name, hint=ORDER_HINT, as_text=True)
    return replace(parsed, entries=entries, assign=assign, named=False)


def _lenses(arrays: _Arrays, name: str) -> tuple[Array, Array | None]:
    """Focal lengths [n, 2] and principal points [n, 2] of the pictures; None where they are not said."""
    lenses, centres = arrays.numbers(name), arrays.name_of(_CENTRES)
    centre = None if centres is None else arrays.numbers(centres)
    if centre is not None and centre.shape != (arrays.count, 2):
        raise invalid_file(
            f"{arrays.file.name} {centres}", f"has the shape {centre.shape}, not [n, 2].", _HINT
        )
    if lenses.shape[1:] == (3, 3):
        return lenses[:, [0, 1], [0, 1]], lenses[:, :2, 2] if centre is None else centre
    if lenses.size not in (arrays.count, 2 * arrays.count):
        raise invalid_file(
            f"{arrays.file.name} {name}", f"has the shape {lenses.shape}, of no lenses.", _HINT
        )
    return np.broadcast_to(lenses.reshape(arrays.count, -1), (arrays.count, 2)), centre


def _lens_at(
    arrays: _Arrays, focal: Array, centre: Array | None, poses_name: str
) -> Callable[..., FrameCamera]:
    """The lens of a photo by its number, the place of its pose in the file, and its header."""
    picture = arrays.picture_size(centre)
    vggt = picture is not None and (poses_name == "extrinsic" or max(picture) == VGGT)
    margins = arrays.margins(picture) if vggt and picture is not None else []

    def seen(number: int, photo: Size) -> tuple[Seen, Size]:
        if poses_name in _WORLD_FROM_CAM:
            return seen_by_dust3r(photo, small=picture is not None and max(picture) <= _MOST_SMALL)
        if picture is None or min(picture) <= 0:
            raise invalid_file(arrays.file.name, "does not say how large the scaled pictures are.", _HINT)
        if margins:
            return seen_by_vggt(photo, picture, margins[number]), picture
        return seen_by_depth_anything(photo, picture), picture

    def lens(number: int, where: str, header: ImageHeader, _name: str) -> FrameCamera:
        photo = (header.width, header.height)
        where_in, size = seen(number, photo)
        x, y = (size[0] / 2, size[1] / 2) if centre is None else centre[number]
        camera = lens_of(where_in.lens_of_photo(tuple(focal[number]), (x, y)), where, photo)
        refuse_other_units(camera, where)
        return FrameCamera(camera, "predicted")

    return lens


def _recognises(names: tuple[str, ...], file: Path) -> bool:
    try:
        arrays = _Arrays(file)
    except (InputError, OSError):
        return False
    return arrays.name_of(names) is not None and arrays.name_of(_LENSES) is not None


def _root(file: Path) -> Path:
    return file.parents[2] if file.parent.parent.name == "exports" else file.parent


CODECS = (
    Codec(
        FEED_FORWARD,
        parse=lambda _root, file: _parse(FEED_FORWARD, _CAM_FROM_WORLD, file),
        recognises=partial(_recognises, _CAM_FROM_WORLD),
        image_root=_root,
    ),
    Codec(
        DUST3R,
        parse=lambda _root, file: _parse(DUST3R, _WORLD_FROM_CAM, file),
        recognises=partial(_recognises, _WORLD_FROM_CAM),
    ),
)
