"""Where masks lie beside images, by the conventions of COLMAP and instant-ngp."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from biresnerf.data.model.safe_names import lies_in, refuse_outside
from biresnerf.data.photos.image_files import find_image
from biresnerf.errors import InputError

COLMAP_MASKS = "masks"  # masks/NAME.png, NAME with its own extension: black does not count


def mask_beside(root: Path, image: Path, name: str, within: Path | None = None) -> tuple[Path | None, bool]:
    """The mask that lies ready for ``image``, and whether it is black where pixels do count.

    That is ``root``/masks/``name``.png as for COLMAP, where black does not count; else instant-ngp's.
    """
    for stem in dict.fromkeys((name.removeprefix("images/"), name)):
        candidate = root / COLMAP_MASKS / f"{stem}.png"
        if _is_ready(candidate, within):
            return candidate, False
    return dynamic_mask(image, within)


def dynamic_mask(image: Path, within: Path | None = None) -> tuple[Path | None, bool]:
    """instant-ngp's dynamic_mask_STEM.png beside ``image``, in which all but black does not count."""
    candidate = image.with_name(f"dynamic_mask_{image.stem}.png")
    ready = _is_ready(candidate, within)
    return (candidate, True) if ready else (None, False)


def named_mask(file: Path, name: Any, where: str, within: Path | None = None) -> Path:
    """The mask that a frame of ``file`` names, as images are named.

    Raises:
        InputError: ``mask_missing``, or ``unsafe_path`` where it leads out of ``within``.
    """
    if isinstance(name, str) and within is not None:
        refuse_outside(
            [file.parent / name, file.parent / name.replace("\\", "/")], [name, name], within, where
        )
    path = find_image(file.parent, name) if isinstance(name, str) else None
    if path is None:
        raise InputError(
            "mask_missing",
            "there is no such mask.",
            where=where,
            hint="Put the mask there (the path is relative to the file), or remove mask_path.",
        )
    return path


def _is_ready(candidate: Path, within: Path | None) -> bool:
    return candidate.is_file() and (within is None or lies_in(candidate, within.resolve()))
