"""Masks: where they lie, and which pixels of a photo count. Black ones do not, as in COLMAP and nerfstudio."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from biresnerf.data.model.dataset import Dataset, Frame
from biresnerf.data.photos.decode import as_stored
from biresnerf.data.photos.image_files import (
    DAMAGED,
    header_of,
    images_called,
    is_image_name,
    open_image,
    quiet_pillow,
    read_header,
)
from biresnerf.data.photos.named_images import lies_in, refuse_outside
from biresnerf.data.photos.orientation import same_shape, turned, turned_size
from biresnerf.data.photos.photo_folders import few_names, visible
from biresnerf.data.photos.shear import straightened_mask
from biresnerf.errors import InputError
from biresnerf.geometry.camera.camera_models import Camera

# JPEG and lossy WebP keep no exact black; what they store lies on the nearer side of the middle.
_LOSSY, _LOSSY_BLACK_BELOW = frozenset({"JPEG", "MPO", "WEBP"}), 128
LEAST_SHARE = 1e-3  # of a photo's pixels must count: fewer are too few to measure anything
_WHOLLY = 1 - 1e-6
COLMAP_MASKS = "masks"  # masks/NAME.png, NAME with its own extension: black does not count
_PICTURES = (".png", ".PNG", ".jpg", ".JPG", ".jpeg", ".tif")
_MARKED = tuple(mark + suffix for mark in ("_mask", ".mask") for suffix in _PICTURES)


def mask_beside(root: Path, image: Path, name: str, within: Path | None = None) -> tuple[Path | None, bool]:
    """The mask that lies ready for ``image``, and whether it is black where pixels do count.

    That is ``root``/masks/``name``.png as for COLMAP, or what other programs call it: masks/STEM.png and the like, or
    NAME.mask.png (RealityCapture) or STEM_mask.jpg (OpenDroneMap) beside the photo; black does not count in all of
    them. Else it is instant-ngp's.
    """
    for candidate in _called(root, image, name):
        if _is_ready(candidate, within):
            return candidate, False
    return dynamic_mask(image, within)


def _called(root: Path, image: Path, name: str) -> Iterator[Path]:
    for path in dict.fromkeys((re.sub(r"^images(_\d+)?/", "", name), name)):
        place = root / COLMAP_MASKS / path
        yield place.with_name(f"{place.name}.png")
        yield from (place.with_name(place.stem + end) for end in (*_PICTURES, *_MARKED))
    yield image.with_name(f"{image.name}.mask.png")
    yield from (image.with_name(image.stem + end) for end in _MARKED)


def mask_notes(root: Path, frames: Sequence[Frame]) -> list[str]:
    """How many photos have a mask, and which pictures in mask folders are none."""
    used = {frame.mask.absolute() for frame in frames if frame.mask is not None}
    masked = sum(frame.mask is not None for frame in frames)
    notes = [f"masks were found for {masked} of {len(frames)} images"] if masked else []
    for folder in visible(root):
        if not folder.is_dir() or not re.search(r"(?<![a-z])masks?(?![a-z])", folder.name.lower()):
            continue
        pictures = [one for one in folder.rglob("*") if is_image_name(one) and one.absolute() not in used]
        if pictures:
            listed = few_names(sorted(one.relative_to(folder).as_posix() for one in pictures), 3)
            notes.append(
                f"{folder.name}/ holds {len(pictures)} pictures that are not used as masks ({listed}): give masks the "
                "names of the photos, in masks/, or name them by mask_path in a transforms.json"
            )
    return notes


def mask_place(frame: Frame) -> tuple[Path, bool]:
    """The file in which a mask for the frame is looked for in all formats, and whether it is black where pixels count.

    That is the mask that it has, else instant-ngp's, which may not be there yet.
    """
    return (frame.mask, frame.mask_inverted) if frame.mask else (_dynamic(frame.path), True)


def dynamic_mask(image: Path, within: Path | None = None) -> tuple[Path | None, bool]:
    """instant-ngp's dynamic_mask_STEM.png beside ``image``, in which all but black does not count."""
    candidate = _dynamic(image)
    ready = _is_ready(candidate, within)
    return (candidate, True) if ready else (None, False)


def _dynamic(image: Path) -> Path:
    return image.with_name(f"dynamic_mask_{image.stem}.png")


def named_mask(file: Path, name: Any, where: str, within: Path | None = None) -> Path:
    """The mask that a frame of ``file`` names, as images are named.

    Raises:
        InputError: ``mask_missing``, or ``unsafe_path`` where it leads out of ``within``.
    """
    if isinstance(name, str) and within is not None:
        refuse_outside(
            [file.parent / name, file.parent / name.replace("\\", "/")], [name, name], within, where
        )
    found = images_called(file.parent, name) if isinstance(name, str) else []
    if not found:
        raise InputError(
            "mask_missing",
            "there is no such mask.",
            where=where,
            hint="Put the mask there (the path is relative to the file), or remove mask_path.",
        )
    return found[0]


def _is_ready(candidate: Path, within: Path | None) -> bool:
    return candidate.is_file() and (within is None or lies_in(candidate, within.resolve()))


def refuse_unfit_mask(frame: Frame, camera: Camera) -> None:
    """Looks at the header of the frame's mask, if it has one.

    Raises:
        InputError: ``mask_size_mismatch``, or what `open_image` says of a file that is no image.
    """
    if frame.mask is not None:
        header = read_header(frame.mask, _where(frame))
        _turn_to_fit(frame, camera, header.width, header.height, header.orientation)


def load_mask(frame: Frame, camera: Camera) -> NDArray[np.bool_] | None:
    """Which pixels count, bool [h, w] at the mask's own size, turned and straightened as the photo; None where all do.

    Any kind of picture will do. A pixel counts unless it is black; in formats with losses, unless it is darker than
    the middle; a transparent one does not. An inverted mask (``Frame.mask_inverted``) means the opposite.

    Raises:
        InputError: ``mask_size_mismatch`` where the mask is no copy of the photo's shape, ``mask_hides_image`` where
            next to nothing counts, ``not_an_image``, ``image_truncated`` or ``image_too_large``.
    """
    if frame.mask is None:
        every = np.ones((camera.height, camera.width), dtype=np.bool_)
        return straightened_mask(every, camera.shear) if camera.shear else None
    with open_image(frame.mask, _where(frame)) as image:
        header = header_of(image)
        turn = _turn_to_fit(frame, camera, header.width, header.height, header.orientation)
        try:
            image.load()
            counts = as_stored(_not_black(image) ^ frame.mask_inverted, image, header.orientation)
        except DAMAGED:
            raise InputError(
                "image_truncated", "is cut off or damaged.", where=_where(frame), hint="Copy the mask again."
            ) from None
    if counts.mean() < LEAST_SHARE:
        raise InputError(
            "mask_hides_image",
            f"leaves {100 * counts.mean():.2g} % of the photo: {_meaning(frame)}.",
            where=_where(frame),
            hint="Invert the mask if it means the opposite; else remove the frame, or its mask.",
        )
    return straightened_mask(turned(counts, turn), camera.shear)


def is_masked(dataset: Dataset) -> bool:
    """Whether some pixels of a photo may not count."""
    return any(frame.mask is not None for frame in dataset.frames) or any(c.shear for c in dataset.cameras)


def shrink_mask(counts: NDArray[np.bool_], width: int, height: int) -> NDArray[np.bool_]:
    """``counts`` [h, w] at another size: a pixel counts where all that it covers does.

    Where that leaves nothing (a mask of dots), those count that cover most of what does.
    """
    covered = _sums(_sums(counts, height).T, width).T * (width * height / counts.size)
    whole: NDArray[np.bool_] = covered >= _WHOLLY
    return whole if whole.any() else covered >= _WHOLLY * covered.max()


def write_masks(dataset: Dataset, names: Sequence[str], folder: Path) -> bool:
    """Writes the masks as COLMAP wants them, ``folder``/``name``.png of the photo's full size; False if there are none.

    Photos without a mask get a white one: COLMAP leaves out photos whose mask it does not find. ``names`` are those
    that COLMAP is given for the frames, in their order.
    """
    if not is_masked(dataset):
        return False
    for index, (frame, name) in enumerate(zip(dataset.frames, names, strict=True)):
        camera = dataset.camera_of(index)
        with quiet_pillow():
            counts = load_mask(frame, camera)
        full = np.ones((camera.height, camera.width), dtype=np.bool_)
        if counts is not None:
            full = shrink_mask(counts, camera.width, camera.height)
        path = folder / f"{name}.png"
        path.parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(full.astype(np.uint8) * 255).save(path)
    return True


def _meaning(frame: Frame) -> str:
    if frame.mask_inverted:
        return "black pixels count, all others do not"
    return "black pixels do not count, all others do"


def _where(frame: Frame) -> str:
    return f"{frame.name} mask {frame.mask.name if frame.mask else ''}"


def _turn_to_fit(frame: Frame, camera: Camera, width: int, height: int, orientation: int) -> int:
    """The orientation that brings a stored mask onto the photo as its frame means it."""
    if same_shape(*turned_size(width, height, frame.orientation), camera.width, camera.height) and (
        orientation == frame.orientation or not same_shape(width, height, camera.width, camera.height)
    ):
        return frame.orientation
    if same_shape(width, height, camera.width, camera.height):
        return 1
    raise InputError(
        "mask_size_mismatch",
        f"has {width} x {height} px, the photo {camera.width} x {camera.height}: not the same shape.",
        where=_where(frame),
        hint="Give a mask of the photo's size, or of that scaled by one factor.",
    )


def _not_black(image: Image.Image) -> NDArray[np.bool_]:
    if image.mode == "F" or image.mode.startswith("I"):
        return np.asarray(image) > 0
    values = np.asarray(image.convert("RGBA"))
    bright = values[..., :3].max(axis=2) * (values[..., 3] > 0)
    return np.asarray(bright >= (_LOSSY_BLACK_BELOW if image.format in _LOSSY else 1))


def _sums(values: NDArray[np.generic], parts: int) -> NDArray[np.float64]:
    """Sums of ``values`` [h, w] over equal parts of the rows, float64 [parts, w]; fractions of a row count as such."""
    rows = len(values)
    total = np.zeros((rows + 1, values.shape[1]), dtype=np.float64)
    np.cumsum(values, axis=0, out=total[1:])
    edges = np.arange(parts + 1) * (rows / parts)
    below = np.minimum(edges.astype(np.int64), rows - 1)
    upto = total[below] + (edges - below)[:, None] * (total[below + 1] - total[below])
    return np.diff(upto, axis=0)
