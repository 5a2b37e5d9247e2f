"""Sets with a few bad frames: the others are read, and a note says what was left out."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TypeVar

from biresnerf.data.photos.named_images import MIN_IMAGES
from biresnerf.data.photos.photo_folders import few_names
from biresnerf.errors import InputError

T = TypeVar("T")


def attempt(make: Callable[[], T]) -> T | InputError:
    """What ``make`` gives, or the error that it raises. ``unsafe_path`` is raised: it is no slip of one frame."""
    try:
        return make()
    except InputError as error:
        if error.code == "unsafe_path":
            raise
        return error


def tolerate(bad: int, total: int, error: InputError, *, strict: bool) -> None:
    """Raises ``error``, that of the first bad frame, unless most frames and at least three are good."""
    good = total - bad
    if bad and (strict or good < MIN_IMAGES or good <= bad):
        raise error


def missing_images(missing: Sequence[str], total: int, where: str, hint: str, *, strict: bool) -> list[str]:
    """A note on images of these names that were not found.

    Raises:
        InputError: ``image_missing``, by the rule of `tolerate`.
    """
    if not missing:
        return []
    listed = f"{len(missing)} of {total} images not found: {few_names(missing)}"
    tolerate(
        len(missing), total, InputError("image_missing", f"{listed}.", where=where, hint=hint), strict=strict
    )
    return [f"{listed}; they are left out"]


def good_frames(
    outcomes: Sequence[T | InputError], names: Sequence[str], *, strict: bool
) -> tuple[list[T], list[int], list[str]]:
    """The results of the good frames, their indices, and a note on the others.

    Raises:
        InputError: the first of ``outcomes``, by the rule of `tolerate`.
    """
    errors = {index: one for index, one in enumerate(outcomes) if isinstance(one, InputError)}
    if not errors:
        return [one for one in outcomes if not isinstance(one, InputError)], list(range(len(outcomes))), []
    first = next(iter(errors.values()))
    tolerate(len(errors), len(outcomes), first, strict=strict)
    kept = [index for index in range(len(outcomes)) if index not in errors]
    listed = few_names((f"{names[index]} ({said(error)})" for index, error in errors.items()), 3)
    note = f"{len(errors)} of {len(outcomes)} images are left out: {listed}"
    return [one for one in outcomes if not isinstance(one, InputError)], kept, [note]


def said(error: InputError) -> str:
    """The error as text for a note: the place, and what is wrong there."""
    return f"{error.where}: {error.detail.removesuffix('.')}"
